"""Table of the integration methods. A new method requires a module with its compiled steps, and a row in this table.

The scenario schema, the choice and checks of the method, dense output, the tables of supported features and the tests
read this table. This module imports no compiled code.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

# Dense output within a step from y to y_new, see ``dynsim.integrators.run.fill_dense``.
LINEAR, HERMITE, COLLOCATION = 0, 1, 2


class Method(NamedTuple):
    """One integration method.

    Attributes
    ----------
    name : str
        Value of the key ``integrator.method``.
    number : int
        Value of ``Run.method`` in compiled code.
    order : int
        Order of the solution at the ends of steps between events.
    advance : str
        Module and name of the compiled ``advance(system, ws, run, limit)`` of the method, joined by a colon.
    dense : int
        ``LINEAR``; ``HERMITE``: the cubic through states and derivatives at both ends, plus
        θ² (1 − θ)² h Σ b_s k_s over the stages k_s; ``COLLOCATION``: the cubic through the stages of RADAU5.
    stability : float
        Largest stable |h λ| on the negative real axis; 0 for an implicit method.
    quartic : tuple of float
        Coefficients b_s of the seven stages, for ``HERMITE``.
    adaptive : bool
        Whether error control chooses the steps, which then end at events.
    """

    name: str
    number: int
    order: int
    advance: str
    dense: int
    stability: float
    quartic: tuple[float, ...] = (0.0,) * 7
    adaptive: bool = True

    @property
    def explicit(self) -> bool:
        """Whether fast eigenvalues limit the steps of the method."""
        return self.stability > 0.0


DOPRI5 = Method(
    "dopri5",
    number=0,
    order=5,
    advance="dynsim.integrators.driver:advance_dopri5",
    dense=HERMITE,
    stability=3.3,
    # Source: Hairer, Nørsett, Wanner: Solving Ordinary Differential Equations I, II.6.
    quartic=(
        -12715105075.0 / 11282082432.0,
        0.0,
        87487479700.0 / 32700410799.0,
        -10690763975.0 / 1880347072.0,
        701980252875.0 / 199316789632.0,
        -1453857185.0 / 822651844.0,
        69997945.0 / 29380423.0,
    ),
)
RADAU5 = Method(
    "radau5", number=1, order=5, advance="dynsim.integrators.driver:advance_radau5", dense=COLLOCATION, stability=0.0
)
TIME_STEPPING = Method(
    "time_stepping",
    number=2,
    order=2,
    advance="dynsim.integrators.stepping.step:advance_moreau",
    dense=LINEAR,
    stability=0.0,
    adaptive=False,
)
BOGACKI_SHAMPINE = Method(
    "bogacki_shampine",
    number=3,
    order=3,
    advance="dynsim.integrators.bogacki_shampine:advance_bogacki_shampine",
    dense=HERMITE,
    stability=2.5,
)

METHODS = {method.name: method for method in (DOPRI5, RADAU5, TIME_STEPPING, BOGACKI_SHAMPINE)}
"""All methods by name; their numbers differ."""

_BY_NUMBER = {method.number: method for method in METHODS.values()}


def by_number(number: int) -> Method:
    """Return the method of a run.

    Raises
    ------
    ValueError
        If no method has this number.
    """
    if number not in _BY_NUMBER:
        raise ValueError(f"unknown integration method number {number}; numbers: {', '.join(map(str, _BY_NUMBER))}")
    return _BY_NUMBER[number]


@cache
def compiled(number: int) -> Callable[..., Any]:
    """Return the compiled ``advance`` of the method with this number."""
    module, _, name = by_number(number).advance.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function
