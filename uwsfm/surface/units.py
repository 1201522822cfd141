"""Lengths in words."""


def short_unit(unit: str) -> str:
    """What stands behind numbers: "m", "arbitrary unit", or the unit itself."""
    return {"metre": "m", "scale arbitrary": "arbitrary unit"}.get(unit, unit)


def length_words(value: float, unit: str) -> str:
    """Two digits of a length, with what it is in.

    Args:
        value: in the unit.
        unit: "metre", or else what is put behind the number.
    """
    if unit != "metre":
        return f"{value:.2g} ({unit})"
    return f"{1e3 * value:.2g} mm" if value < 0.1 else f"{value:.2g} m"
