"""An adjustment that fails has a cause, too: it is looked for, and named."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import ExplainedInputError, InputError, UwsfmError
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.refine import Refined, refine_scene
from uwsfm.trust.diagnosis import KEPT, diagnose


def refined_or_explained(
    scene: Scene,
    rig: Rig,
    frame_names: Sequence[str],
    progress: Progress = silent,
    **options: Any,
) -> Refined:
    """`refine_scene`; where it comes to no end that is physical, with the cause.

    Args:
        scene: As of `refine_scene`.
        rig: As given.
        frame_names: Of the scene's frames.
        progress: As of `refine_scene`.
        **options: Further arguments of `refine_scene`.

    Raises:
        ExplainedInputError: it failed, and a mistake explains the observations.
        UwsfmError: it failed, and none does.
    """
    try:
        return refine_scene(scene, rig, progress, **options)
    except InputError:  # names its cause
        raise
    except UwsfmError as error:
        kept = {name: value for name, value in options.items() if name in KEPT}
        causes = diagnose(rig, scene, frame_names, progress, **kept)
        if not causes:
            raise
        words = " ".join(one.text for one in causes)
        codes = tuple(one.code for one in causes)
        raise ExplainedInputError(f"{error}. {words}", codes) from error
