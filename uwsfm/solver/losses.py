"""Robust losses rho(s) of the squared residual s, in pixels squared."""

import math

from uwsfm._base.jit import inner

L2, CAUCHY = 0, 1
LOSS_CODES = {"l2": L2, "cauchy": CAUCHY}

INVALID_PX = 100.0
"""What an observation costs that cannot be projected: as a residual of this size. It
has no Jacobian; a smaller price would let a step win by driving points out of the
water."""


@inner
def rho(s, loss, scale):
    """(rho(s), rho'(s)): l2 is s, cauchy is c^2 log(1 + s / c^2)."""
    if loss == CAUCHY:
        c2 = scale * scale
        return c2 * math.log1p(s / c2), 1.0 / (1.0 + s / c2)
    return s, 1.0
