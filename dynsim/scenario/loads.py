"""The ``loads:`` section of a scenario: forces and torques on bodies, and payloads fixed to them."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from dynsim.config.base import BodyPoint, NonNegative, Vector3, error_at
from dynsim.record.csv_rows import read_rows

FORCE_COLUMNS = ("t_s", "fx_N", "fy_N", "fz_N")
TORQUE_COLUMNS = ("mx_N_m", "my_N_m", "mz_N_m")

# Times, (K + 1,) [s], and coefficients of cubic polynomials of the six components between them, (K, 6, 4).
Pieces = tuple[NDArray[np.float64], NDArray[np.float64]]


class WrenchConfig(BodyPoint):
    """Where a wrench acts, and in which axes it is given."""

    frame: Literal["world", "body"] = Field(default="world", description="axes of force and torque")


class Constant(WrenchConfig):
    """A constant force and torque."""

    type: Literal["constant"]
    force_N: Vector3 = [0.0, 0.0, 0.0]
    torque_N_m: Vector3 = Field(default=[0.0, 0.0, 0.0], description="about the point")

    @property
    def hold(self) -> bool:
        """It has no end."""
        return True

    def pieces(self, duration: float) -> Pieces:
        """One constant piece from 0 to ``duration`` [s]."""
        coefficients = np.zeros((1, 6, 4))
        coefficients[0, :, 0] = [*self.force_N, *self.torque_N_m]
        return np.array([0.0, duration]), coefficients


class Sampled(WrenchConfig):
    """A force and a torque through samples."""

    interpolation: Literal["spline", "linear"] = Field(
        default="spline", description="spline: cubic, not-a-knot (of two samples a line, of three a parabola)"
    )
    hold: bool = Field(default=False, description="first and last sample go on beyond the times, else it is zero there")
    # Of all columns, made once: an edit of a file does not change a scenario that is already loaded.
    _pieces: Pieces = PrivateAttr()

    def pieces(self, duration: float) -> Pieces:
        """Times and polynomials through the samples."""
        return self._pieces

    def _interpolate(self, times: list[float], values: NDArray[np.float64]) -> Pieces:
        """Polynomials through ``values``, (T, 6); ValueError where rounding leaves them not finite or off these."""
        knots = np.array(times)
        try:
            with np.errstate(all="ignore"):
                coefficients = self._coefficients(knots, values)
                step = np.diff(knots)[:, None] ** np.arange(4)
                met = np.allclose(np.einsum("kcp,kp->kc", coefficients, step), values[1:], rtol=1e-9, atol=1e-12)
        except ValueError:  # slopes that overflow
            met = False
        if not (met and np.isfinite(coefficients).all()):
            raise ValueError("numbers too large, or samples too close in time, for a curve through them")
        return knots, coefficients

    def _coefficients(self, knots: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        if self.interpolation == "spline":
            from scipy.interpolate import CubicSpline  # takes 0.3 s

            return np.ascontiguousarray(CubicSpline(knots, values).c[::-1].transpose(1, 2, 0))
        coefficients = np.zeros((len(knots) - 1, 6, 4))
        coefficients[:, :, 0] = values[:-1]
        coefficients[:, :, 1] = np.diff(values, axis=0) / np.diff(knots)[:, None]
        return coefficients


class Samples(Sampled):
    """Force and torque at ``times_s``."""

    type: Literal["samples"]
    times_s: list[float] = Field(min_length=2)
    force_N: list[Vector3] | None = Field(default=None, description="one vector for each time; default: no force")
    torque_N_m: list[Vector3] | None = Field(default=None, description="about the point, likewise")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.any(np.diff(self.times_s) <= 0.0):
            raise error_at("times_s", "must increase")
        values = {"force_N": self.force_N, "torque_N_m": self.torque_N_m}
        for key, vectors in values.items():
            if vectors is not None and len(vectors) != len(self.times_s):
                raise error_at(key, f"{len(vectors)} vectors and {len(self.times_s)} times_s: there must be as many")
        if self.force_N is None and self.torque_N_m is None:
            raise ValueError("has neither force_N nor torque_N_m")
        nothing = np.zeros((len(self.times_s), 3))
        columns = [nothing if vectors is None else np.array(vectors) for vectors in values.values()]
        self._pieces = self._interpolate(self.times_s, np.hstack(columns))
        return self


class Table(Sampled):
    """Force and torque from a CSV file."""

    type: Literal["csv"]
    file: str = Field(
        description=f"CSV file, relative to the scenario file, with a header {','.join(FORCE_COLUMNS)}, "
        f"or that and {','.join(TORQUE_COLUMNS)}"
    )

    @model_validator(mode="after")
    def _read(self) -> Self:
        rows = np.array(read_rows(self.file, FORCE_COLUMNS, FORCE_COLUMNS + TORQUE_COLUMNS, kind="a load"))
        values = np.zeros((len(rows), 6))
        values[:, : rows.shape[1] - 1] = rows[:, 1:]
        try:
            self._pieces = self._interpolate(rows[:, 0].tolist(), values)
        except ValueError as error:
            raise ValueError(f"{self.file}: {error}") from None
        return self


class Payload(BodyPoint):
    """A body that is fixed to one of the robot's; its centre of mass is at ``point_m``; without mass it is none."""

    type: Literal["payload"]
    mass_kg: NonNegative
    radius_m: NonNegative = Field(default=0.0, description="of a solid sphere; zero: a point mass")
    inertia_kg_m2: Annotated[list[NonNegative], Field(min_length=3, max_length=3)] | None = Field(
        default=None, description="xx yy zz about the centre of mass, in the axes of body; default: the sphere's"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.inertia_kg_m2 is not None and self.radius_m > 0.0:
            raise error_at("inertia_kg_m2", "cannot be given together with radius_m; remove one of the two")
        if self.inertia_kg_m2 is not None and self.mass_kg == 0.0:
            raise error_at("inertia_kg_m2", "cannot be that of mass_kg = 0; remove it, or give radius_m instead")
        return self


LoadConfig = Annotated[Constant | Samples | Table | Payload, Field(discriminator="type")]
