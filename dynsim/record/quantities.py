"""Names, symbols and units of the numbers in summaries, derived from their keys."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

# Units at the end of a key, and how they are printed; ``per`` separates numerator and denominator.
_UNITS = {
    "deg": "°", "rad": "rad", "m": "m", "m2": "m²", "m3": "m³", "kg": "kg", "s": "s", "s2": "s²", "hz": "Hz", "N": "N",
    "J": "J", "W": "W", "Wh": "Wh", "V": "V", "A": "A", "H": "H", "ohm": "Ω", "GB": "GB", "per": "/",
}  # fmt: skip
# Units of time that follow a length or an angle are in the denominator: ``m_s`` is m/s, but ``N_s_per_m`` is N s/m.
_RATES = {"m_s": "m/s", "m_s2": "m/s²", "rad_s": "rad/s", "rad_s2": "rad/s²", "kg_m3": "kg/m³"}
# Lengths are shown in millimetres if the largest is in this range [m].
SMALL_M = 1e-5, 0.1
# Last words of keys that qualify the quantity before them.
_QUALIFIERS = ("rms", "max", "min", "mean", "initial", "final", "start", "end")
# Names that the words of a key do not give.
_NAMES = {
    "electrical_energy_supply": "energy, one supply",
    "electrical_energy_drawn": "energy, separate supplies",
    "joule_heat": "Joule heat",
    "impact_loss": "impact loss, all contacts",
    "scheme_loss": "loss of time stepping",
    "hand_error_z_rms": "hand error, vertical, rms",
    "hand_error_start": "hand error, at the start",
    "hand_error_end": "hand error, at the end",
    "hand_turn_error_rms": "hand orientation error, rms",
    "hand_turn_error_max": "hand orientation error, max",
    "joint_limit_violation_max": "joint limit exceeded by",
    "energy_residual_relative": "ledger residual, relative",
    "tip_margin_min": "tip margin, whole run",
    "tip_margin_min_settled": "tip margin, settled",
    "overturns_settled_at": "tips over at",
    "wheel_load_min": "wheel load, min",
    "method": "integration method",
    "integration_wall": "integration",
    "real_time_factor": "speed, times real time",
    "rating_share": "rms torque / rating",
    "payload_error": "heat with payload error / planned",
    "mass_error": "heat with mass error / planned",
}
_SYMBOLS = {"normal_force": "f_n", "torque": "τ", "current": "i"}
_SIDES = ("left", "right", "caster")
# Lengths that are always shown in millimetres.
_IN_MILLIMETRES = ("hand_error", "hand_sag", "sinking", "gap_min")
# Results of a sweep in its table and figures, unless the user selects others: energy, and the first error that the runs
# have.
ENERGY, ERRORS = "electrical_energy_J", ("hand_error_rms_m", "final_position_error_m")


@dataclass(frozen=True)
class Quantity:
    """Name, symbol and unit of a number, as they are shown to a reader.

    Attributes
    ----------
    name : str
        Name, e.g. ``"hand error, rms"``.
    symbol : str
        Symbol, e.g. ``"μ"``; "" without a symbol.
    unit : str
        Unit, e.g. ``"N m s/rad"``; "" for a number without a unit.
    scale : float
        Factor from the number under the key to the unit, e.g. 1000 for a length in millimetres.

    Examples
    --------
    >>> Quantity("height of table", unit="m").fitted([0.01, 0.05])
    Quantity(name='height of table', symbol='', unit='mm', scale=1000.0)
    """

    name: str
    symbol: str = ""
    unit: str = ""
    scale: float = 1.0

    @property
    def label(self) -> str:
        """Name with the unit in brackets, for headings and axes."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def fitted(self, values: Iterable[object]) -> Quantity:
        """Return the quantity in millimetres if it is a length and the largest of ``values`` is 0.01 to 100 mm."""
        sizes = [abs(value) for value in values if isinstance(value, (int, float))]
        small = self.unit == "m" and SMALL_M[0] <= max(sizes, default=0.0) < SMALL_M[1]
        return replace(self, unit="mm", scale=1e3) if small else self


def rounded(value: float, digits: int = 4, zeros: str = "") -> str:
    """Round a number to significant digits, for tables and figures.

    Parameters
    ----------
    value : float
        Number.
    digits : int, optional
        Number of significant digits; all digits before the decimal point are kept.
    zeros : {"", "#"}, optional
        "#" keeps zeros at the end, unless the number is an integer.

    Returns
    -------
    str
        The number, with an exponent if it is very small or very large.

    Examples
    --------
    >>> [rounded(value) for value in (12, 25123.4, 6.26, 0.85213, 0.0, 1.17e12)]
    ['12', '25123', '6.26', '0.8521', '0', '1.17e+12']
    >>> rounded(6.26, zeros="#")
    '6.260'
    """
    if isinstance(value, int) or value == 0.0 or 10**digits <= abs(value) < 1e7:
        return f"{value:.0f}"
    return f"{value:{zeros}.{digits}g}".removesuffix(".")


def unit_of(key: str) -> tuple[str, str]:
    """Split a key into its words and its unit.

    Parameters
    ----------
    key : str
        Key without dots.

    Returns
    -------
    words, unit : str
        The key without the unit, and the unit as it is printed; "" for a key without a unit.

    Examples
    --------
    >>> unit_of("damping_N_m_s_per_rad"), unit_of("friction")
    (('damping', 'N m s/rad'), ('friction', ''))
    """
    words = key.split("_")
    first = len(words)
    while first > 1 and words[first - 1] in _UNITS:
        first -= 1
    suffix = "_".join(words[first:])
    unit = " ".join(_UNITS[word] for word in words[first:]).replace(" / ", "/").replace("/ ", "1/")
    return "_".join(words[:first]), _RATES.get(suffix, unit)


def summary_quantity(key: str) -> Quantity:
    """Return the quantity of a number in a summary or in the table of a sweep.

    Parameters
    ----------
    key : str
        Key of ``summary.json``; the part before the last dot is the contact, joint or section: ``elbow_c.gap_min_m``.

    Returns
    -------
    Quantity
        Its name starts with the contact, joint or section.

    Examples
    --------
    >>> summary_quantity("elbow_c.normal_force_max_N").label
    'elbow_c: normal force, max [N]'
    """
    *owners, number = key.split(".")
    if owners and number in _SIDES:  # base.wheel_load_min_N.left
        number, owners[-1] = owners[-1], number
    owner = ".".join(name for name in owners if name != "base")
    words, unit = unit_of(number)
    base, _, qualifier = words.rpartition("_")
    name = f"{base}, {qualifier}" if base and qualifier in _QUALIFIERS else words
    name = (name if owner else _NAMES.get(words, name)).replace("_", " ")
    small = unit == "m" and words.startswith(_IN_MILLIMETRES)
    symbol = _SYMBOLS.get(words, _SYMBOLS.get(base, ""))
    return Quantity(f"{owner}: {name}" if owner else name, symbol, "mm" if small else unit, 1e3 if small else 1.0)
