"""Statistics of many runs: mean with confidence interval, spread, and sensitivity to each sampled parameter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dynsim.record.quaternion import Array

# Confidence level of the interval of the mean, and probability covered by the interval of the samples.
LEVEL = 0.95


@dataclass(frozen=True)
class Spread:
    """Statistics of a quantity over samples.

    Attributes
    ----------
    count : int
        Number of samples.
    mean : float
        Mean of the samples.
    mean_low, mean_high : float
        Confidence interval of the mean at level ``LEVEL``, from Student's t distribution.
    deviation : float
        Standard deviation of the samples.
    low, high : float
        Interval that contains the fraction ``LEVEL`` of the samples, from their quantiles.
    """

    count: int
    mean: float
    mean_low: float
    mean_high: float
    deviation: float
    low: float
    high: float


def student(freedom: int) -> float:
    """Return the half-width of the interval of Student's t distribution at level ``LEVEL``.

    Parameters
    ----------
    freedom : int
        Degrees of freedom.
    """
    from scipy.special import stdtrit  # imported here because the import takes as long as ten runs of a sweep

    return float(stdtrit(freedom, 0.5 + 0.5 * LEVEL))


def spread(values: Array) -> Spread:
    """Return mean and spread of samples, (N,) with N ≥ 2: x̄ ± t(N − 1) s/√N."""
    count, mean, deviation = len(values), float(values.mean()), float(values.std(ddof=1))
    half = student(count - 1) * deviation / np.sqrt(count)
    low, high = np.quantile(values, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return Spread(count, mean, mean - half, mean + half, deviation, float(low), float(high))


@dataclass(frozen=True)
class Sensitivities:
    """Linear model y = b_0 + Σ b_j (x_j − x̄_j)/s_j of a quantity, fitted by least squares.

    Attributes
    ----------
    effect : (k,) ndarray
        Coefficients b_j: change of the quantity per standard deviation s_j of each parameter.
    half_width : (k,) ndarray
        Half-widths of the confidence intervals of ``effect`` at level ``LEVEL``, from Student's t distribution.
    explained : float
        Fraction R² of the variance of the quantity that the model explains.
    """

    effect: Array
    half_width: Array
    explained: float


def sensitivities(parameters: Array, values: Array) -> Sensitivities | None:
    """Fit a linear model of values, (N,), as a function of parameters, (N, k).

    Returns None if the fit is not determined: too few samples, a parameter or value that does not vary, or linearly
    dependent parameters.
    """
    count, size = parameters.shape
    free, deviations = count - size - 1, parameters.std(axis=0, ddof=1) if count > 1 else np.zeros(size)
    total = float(((values - values.mean()) ** 2).sum())
    if free < 1 or not deviations.all() or total == 0.0:
        return None
    scaled = np.column_stack([np.ones(count), (parameters - parameters.mean(axis=0)) / deviations])
    normal = scaled.T @ scaled
    if np.linalg.matrix_rank(scaled) <= size:
        return None
    inverse = np.linalg.inv(normal)
    effects = inverse @ (scaled.T @ values)
    unexplained = float(((values - scaled @ effects) ** 2).sum())
    half = student(free) * np.sqrt(np.diag(inverse) * unexplained / free)
    return Sensitivities(effects[1:], half[1:], 1.0 - unexplained / total)
