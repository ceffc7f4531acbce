"""Robust kernels: rho(s) replaces the squared whitened norm s of a residual, weight(s) = rho'(s) scales its normal equations.

Properties: rho(s) ~ s for small s, weight(0) = 1, weight is the derivative of rho and does not increase.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ..arrays import Floats
from ..config import require_permitted, setting
from ..errors import ConfigError

KernelName = Literal["none", "huber", "cauchy", "geman-mcclure"]
KERNELS: tuple[KernelName, ...] = get_args(KernelName)


@dataclass(frozen=True, slots=True)
class Kernel:
    """A robust kernel and its scale."""

    name: KernelName = "none"
    """Which function of the whitened norm replaces its square; none = the square."""
    scale: float = setting(1.0, above=0.0)
    """Whitened norm (in standard deviations) at which the kernel departs from the square."""

    def __post_init__(self) -> None:
        if self.name not in KERNELS:
            raise ConfigError(f"unknown robust kernel {self.name!r}; choose one of {', '.join(KERNELS)}")
        require_permitted(self)

    def rho(self, s: Floats) -> Floats:
        """Return the robust cost of squared whitened norms s (...)."""
        k2 = self.scale**2
        if self.name == "huber":
            return np.where(s <= k2, s, 2.0 * self.scale * np.sqrt(s) - k2)
        if self.name == "cauchy":
            return k2 * np.log1p(s / k2)
        if self.name == "geman-mcclure":
            return s / (1.0 + s / k2)
        return s

    def weight(self, s: Floats) -> Floats:
        """Return the derivative of rho at squared whitened norms s (...); in [0, 1]."""
        k2 = self.scale**2
        if self.name == "huber":
            return self.scale / np.sqrt(np.maximum(s, k2))
        if self.name == "cauchy":
            return 1.0 / (1.0 + s / k2)
        if self.name == "geman-mcclure":
            return 1.0 / (1.0 + s / k2) ** 2
        return np.ones_like(s)


SQUARED = Kernel()
