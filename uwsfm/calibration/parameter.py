"""What is declared of a calibrated parameter; the parameters are in `parameters`."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uwsfm.models.ports.port import Port


@dataclass(frozen=True)
class Unit:
    """A unit, as people read it."""

    name: str
    """Empty for what has none."""
    per: float = 1.0
    """How many of it make one unit in memory."""
    in_files: str = ""
    """The unit in memory, where a name in a file needs it."""

    def shown(self, value: float, digits: str) -> str:
        """A value in memory, for people.

        Args:
            value: what is shown.
            digits: a format, as ".3g".
        """
        return f"{self.per * value:{digits}} {self.name}".rstrip()

    @property
    def noted(self) -> str:
        """What a name in a file has behind it."""
        return f" ({self.in_files})" if self.in_files else ""


MILLIMETRE = Unit("mm", 1e3, "m")
DEGREE = Unit("deg", math.degrees(1.0))
PIXEL = Unit("px")
NUMBER = Unit("")


@dataclass(frozen=True, kw_only=True)
class Refine:
    """How a person has a parameter refined."""

    field: str
    """Of `CalibrateOptions`."""
    help: str
    default: bool = False
    flag: str | None = None
    """The word of ``--refine``; None: the rig file has it."""


@dataclass(frozen=True, kw_only=True)
class Prior:
    """What is known of a parameter that is refined."""

    field: str
    """Of `CalibrateOptions`, and the key of ``--prior``."""
    help: str
    from_accuracy: bool = False
    """Where no prior is given, the accuracy of the rig file, or its default, is it. For
    what images alone hardly determine."""


@dataclass(frozen=True, kw_only=True)
class Accuracy:
    """How well a parameter is known, as a person states it."""

    key: str
    """In the rig file; the value itself has the same in `summary.json`."""
    most: float
    """What a standard deviation stays below: another unit lies beyond."""
    unit: str
    """With an example, for errors."""
    because: str
    """Why the default is what it is."""
    share: float = 0.0
    least: float = 0.0
    """The default is this share of the value, and at least so much."""
    per: float = 1.0
    """Steps of one slot, in memory, that one unit of the key is."""
    relative: bool = False
    """The key is a share of the value."""
    of_rig: bool = False
    """It stands in the accuracy of the rig, not of a camera."""

    def default(self, value: float = 0.0) -> float:
        """The standard deviation that is assumed, in the unit of the key."""
        return max(self.share * value, self.least)


@dataclass(frozen=True, kw_only=True)
class Parameter:
    """One number of each camera, or a few that belong together."""

    name: str
    """For people, after "the"."""
    group: str
    """Numbers that halves are judged by together."""
    plural: str
    """The name of the group, for people."""
    slots: int | slice
    """In the rows of `uwsfm.residuals.border`."""
    unit: Unit
    accuracy: Accuracy | None = None
    number: str | None = None
    """Of ports, as `uwsfm.models.ports.kind.Port.has` takes it: cameras behind ports
    that have it. None: all cameras."""
    column: int | None = None
    """Of a single number: where it is in the row of a port."""
    step: str = ""
    """One of several numbers in the error budget; {} is an axis. Empty: the name."""
    part: str = ""
    """One of several numbers where halves are compared; {} is an axis."""
    refine: Refine | None = None
    prior: Prior | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Of the value, in memory."""
    listed: bool = False
    """Printed in the list of what else was refined; False: with its port or placement,
    which have rows of their own."""

    @property
    def first(self) -> int:
        """The first of its slots."""
        return self.slots.start if isinstance(self.slots, slice) else self.slots

    @property
    def size(self) -> int:
        """How many numbers it is."""
        if isinstance(self.slots, slice):
            return int(self.slots.stop - self.slots.start)
        return 1

    def of(self, port: "Port | type[Port]") -> bool:
        """Whether a camera behind such a port has it."""
        return self.number is None or port.has(self.number)

    @property
    def has_prior_by_accuracy(self) -> bool:
        """Whether the accuracy of the rig file is its prior where none is given."""
        return self.prior is not None and self.prior.from_accuracy

    def listed_name(self, camera: str, part: str = "") -> str:
        """What a list calls it, with its unit if that is not plain.

        Args:
            camera: that it is of.
            part: name of one of several numbers.
        """
        return f"{part or self.name} of {camera}{self.unit.noted}"
