"""What the command line decides."""

from dataclasses import dataclass
from pathlib import Path

from uwsfm._base.tasks import Workers


@dataclass(frozen=True, kw_only=True)
class Settings:
    runs: int
    """Monte-Carlo runs per level."""
    workers: Workers
    """Who share them."""
    work: Path
    """Images, features and reconstructions, kept for the next time."""
    tank: Path | None
    """Folder of the real rig's images; None: that part is left out."""
