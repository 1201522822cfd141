"""3-vectors as tuples, for kernels."""

from uwsfm._base.jit import inner


@inner
def dot(p, q):
    """<p, q>"""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@inner
def add(p, step, q):
    """p + step q"""
    return p[0] + step * q[0], p[1] + step * q[1], p[2] + step * q[2]


@inner
def scaled(factor, p):
    """factor p"""
    return factor * p[0], factor * p[1], factor * p[2]


@inner
def cross(p, q):
    """p x q"""
    return (
        p[1] * q[2] - p[2] * q[1],
        p[2] * q[0] - p[0] * q[2],
        p[0] * q[1] - p[1] * q[0],
    )
