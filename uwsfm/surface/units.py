"""Lengths in words."""


def length_words(value: float, unit: str) -> str:
    """Two digits of a length, with what it is in.

    Args:
        value: in the unit.
        unit: "metre" or "scale arbitrary".
    """
    if unit != "metre":
        return f"{value:.2g} (scale arbitrary)"
    return f"{1e3 * value:.2g} mm" if value < 0.1 else f"{value:.2g} m"
