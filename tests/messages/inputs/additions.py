"""Loads, objects, ties, sensors, the integrator and the record."""

from messages.case import Edits, Overrides

AREA = "Loads, objects, ties and sensors"
ORDER = 50

ARM = """\
duration_s: 0.1
plant: {type: serial_arm, chain: [{axis: y, length_m: 0.3}, {axis: y, length_m: 0.3}]}
integrator: {method: auto}
"""
STEPPED = f"{ARM.replace('auto', 'time_stepping')}contacts: {{law: unilateral}}\n"
FORCE = "type: samples, body: link_1, times_s: [0, 1]"
BALL = "shape: sphere, mass_kg: 1, radius_m: 0.1, position_m: [2, 0, 1]"
DOOR = "shape: box, mass_kg: 1, size_m: [0.02, 0.4, 0.4], position_m: [1, 0, 1]"
SPRING = "type: linear, body: link_1, other: world, axis: [0, 0, 1], stiffness_N_per_m: 10"
TABLE = "t_s,fx_N,fy_N,fz_N\n0,0,0,0\n0.1,1,0,0\n"
CHECK = 'dynsim.check(dynsim.load_scenario("arm.yaml"))'


def loads(keys: str) -> str:
    return f"loads: {{pull: {{{keys}}}}}\n"


def objects(keys: str, name: str = "ball") -> str:
    return f"objects: {{{name}: {{{keys}}}}}\n"


def wrench(keys: str) -> str:
    return f"sensors: {{wrench: {{gauge: {{{keys}}}}}}}\n"


def ties(keys: str) -> str:
    return f"ties: {{spring: {{{keys}}}}}\n"


TABLES = [
    Edits(
        CHECK,
        {"arm.yaml": ARM},
        [
            ("load of an unknown type", loads("type: push, body: link_1")),
            ("load without a type", loads("body: link_1, force_N: [1, 0, 0]")),
            ("load on a body that does not exist", loads("type: constant, body: link_3, force_N: [1, 0, 0]")),
            ("load that does nothing", loads("type: samples, body: link_1, times_s: [0, 1]")),
            ("force of one component", loads("type: constant, body: link_1, force_N: 3")),
            ("more times than forces", loads(f"{FORCE}, force_N: [[0, 0, 0]]")),
            (
                "times of a load that do not increase",
                loads("type: samples, body: link_1, times_s: [1, 0], force_N: [[0, 0, 0], [1, 0, 0]]"),
            ),
            ("unknown interpolation", loads(f"{FORCE}, force_N: [[0, 0, 0], [1, 0, 0]], interpolation: cubic")),
            ("payload with a negative mass", loads("type: payload, body: link_1, mass_kg: -1")),
            (
                "payload with a radius and an inertia",
                loads("type: payload, body: link_1, mass_kg: 1, radius_m: 0.1, inertia_kg_m2: [1, 1, 1]"),
            ),
            (
                "inertia of a payload without mass",
                loads("type: payload, body: link_1, mass_kg: 0, inertia_kg_m2: [1, 1, 1]"),
            ),
            (
                "inertia of a payload that no body can have",
                loads("type: payload, body: link_1, mass_kg: 1, inertia_kg_m2: [1, 1, 9]"),
            ),
            ("table of forces that does not exist", loads("type: csv, body: link_1, file: none.csv")),
            ("ties without time stepping", ties(SPRING)),
            ("sensors without a controller", "sensors: {encoders: {delay_s: 0.01}}\n"),
            ("unknown sensor", "sensors: {camera: {}}\n"),
            ("negative resolution", "sensors: {encoders: {resolution_deg: -1}}\n"),
            ("encoders that are never read", "sensors: {encoders: {rate_hz: 0}}\n"),
            ("wrench sensor on a body that does not exist", wrench("body: link_3")),
            ("wrench sensor at the world", wrench("body: world")),
            ("wrench sensor without a body", wrench("point_m: [0, 0, 0]")),
            ("wrench sensor with an unknown key", wrench("body: link_1, point: [0, 0, 0]")),
            ("wrench sensor with a frame of another body", wrench("body: link_1, frame: link_2")),
            ("wrench sensor on a frame", f"objects: {{pipe: {{{BALL}, grasp: {{}}}}}}\n{wrench('body: pipe.grasp')}"),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": STEPPED},
        [
            ("object with the name of a body", objects(BALL, "link_1")),
            ("object with the name of the world", objects(BALL, "world")),
            ("object without a shape", objects("mass_kg: 1, position_m: [0, 0, 1]")),
            ("object of an unknown shape", objects(BALL.replace("sphere", "ball"))),
            ("object without mass", objects(BALL.replace("mass_kg: 1, ", ""))),
            ("object of mass zero", objects(BALL.replace("mass_kg: 1", "mass_kg: 0"))),
            ("sphere with a box's size", objects(BALL.replace("radius_m: 0.1", "size_m: [1, 1, 1]"))),
            ("cylinder without its length", objects(BALL.replace("sphere", "cylinder"))),
            ("object of parts without parts", objects("shape: parts, position_m: [0, 0, 1]")),
            (
                "mass of an object of parts",
                objects("shape: parts, mass_kg: 1, position_m: [0, 0, 1], parts: {a: {mass_kg: 1, size_m: [1, 1, 1]}}"),
            ),
            ("parts of a sphere", objects(f"{BALL}, parts: {{a: {{shape: sphere, mass_kg: 1, radius_m: 0.1}}}}")),
            ("object on a hinge and a slide", objects(f"{DOOR}, hinge: {{}}, slide: {{}}")),
            (
                "wheels of an object on a hinge",
                objects(f"{DOOR}, hinge: {{}}, wheels: {{a: {{mass_kg: 1, position_m: [0, 0, 0], radius_m: 0.1}}}}"),
            ),
            ("limits of a hinge that are equal", objects(f"{DOOR}, hinge: {{limits_deg: [10, 10]}}")),
            ("hinge without direction", objects(f"{DOOR}, hinge: {{axis: [0, 0, 0]}}")),
            ("grasp without direction", objects(f"{DOOR}, grasp: {{axis: [0, 0, 0]}}")),
            ("tie to itself", ties(SPRING.replace("world", "link_1"))),
            ("tie to a body that does not exist", ties(SPRING.replace("other: world", "other: wall"))),
            ("tie of a body that does not exist", ties(SPRING.replace("link_1", "link_9"))),
            ("tie without a stiffness", ties(SPRING.replace(", stiffness_N_per_m: 10", ""))),
            ("tie of an unknown type", ties(SPRING.replace("linear", "rubber"))),
            ("tie without direction", ties(SPRING.replace("[0, 0, 1]", "[0, 0, 0]"))),
            ("bound of a tie that only pushes", ties(f"{SPRING}, pushes: true, bound_N: 3")),
        ],
    ),
    Edits(
        CHECK,
        {"arm.yaml": f"{ARM}{loads('type: csv, body: link_1, file: push.csv')}", "push.csv": TABLE},
        [
            ("table of forces with another header", "t_s,fx_N,fy_N,fz_N", "t,Fx,Fy,Fz"),
            ("table of forces with a text", "0.1,1,0,0", "0.1,strong,0,0"),
            ("table of forces of one row", "0.1,1,0,0\n", ""),
        ],
        keyed=False,
    ),
    Overrides(
        "elbow_comparison",
        [
            ("rate of the record that is negative", {"record.rate_hz": -1}),
            ("rate that needs too much memory", {"record.rate_hz": 9.2e5}),
            ("wall limit of zero", {"integrator.wall_limit_s": 0}),
            ("longest step of zero", {"integrator.step_max_s": 0}),
            ("negative settling time", {"metrics.settle_s": -1}),
        ],
    ),
]
