"""Messages of a pilot's page to a drive."""

from messages.case import Calls

AREA = "Messages of a pilot"
ORDER = 150

TABLES = [
    Calls(
        [
            ("bytes", "pilot(b'x')"),
            ("text that is not JSON", "pilot('forward')"),
            ("JSON that is a list", "pilot('[1, 2]')"),
            ("action that is not known", """pilot('{"do": "jump"}')"""),
            ("unknown key of a message", """pilot('{"n": 1, "axis": [0, 0]}')"""),
            ("message without a count", """pilot('{"axes": [0, 0]}')"""),
            ("too few axes", """pilot('{"n": 1, "axes": [0]}')"""),
            ("axis that is a text", """pilot('{"n": 1, "axes": [0, "up"]}')"""),
            ("axis that is not a number", """pilot('{"n": 1, "axes": [0, NaN]}')"""),
            ("number as flag", """pilot('{"n": 1, "axes": [0, 0], "held": 1}')"""),
            ("mode that does not exist", """pilot('{"n": 1, "axes": [0, 0], "mode": 9}')"""),
        ],
    ),
]
