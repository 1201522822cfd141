"""Packages that only files and pictures of surfaces need: imported when they do."""

from importlib import import_module
from types import ModuleType

from uwsfm.errors import MissingPackageError


def import_package(name: str, purpose: str) -> ModuleType:
    """A package of the extra ``inspect``.

    Args:
        name: of the package, or of a module in it.
        purpose: what needs it, as the start of a sentence.

    Raises:
        MissingPackageError: it cannot be imported.
    """
    try:
        return import_module(name)
    except (ImportError, OSError) as error:
        package = name.partition(".")[0]
        raise MissingPackageError(
            f"{purpose} needs the package {package} (pip install 'uwsfm[inspect]'), "
            f"but importing it failed: {error}"
        ) from error
