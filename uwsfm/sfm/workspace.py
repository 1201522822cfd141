"""Where the steps of a reconstruction keep their results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from uwsfm.sfm.frontend.features import COLORS


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Where the steps keep their results."""

    work_dir: Path

    @property
    def features(self) -> Path:
        """Keypoints, descriptors and raw matches of the real images."""
        return self.work_dir / "database.db"

    @property
    def colors(self) -> Path:
        """Colours beneath the keypoints."""
        return self.work_dir / COLORS

    @property
    def rig(self) -> Path:
        """The rig derived from a baseline length."""
        return self.work_dir / "rig.json"

    @property
    def mapping(self) -> Path:
        """Virtual keypoints and verified matches."""
        return self.work_dir / "mapping.db"

    @property
    def perspective(self) -> Path:
        """The perspective model."""
        return self.work_dir / "perspective"

    @property
    def submaps(self) -> Path:
        """Maps of parts of a long survey."""
        return self.work_dir / "submaps"

    @property
    def refractive(self) -> Path:
        """The map of the refraction-aware mapper."""
        return self.work_dir / "refractive"
