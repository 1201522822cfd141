"""Packages that a part of the work needs: imported when it does."""

import re
from importlib import import_module
from types import ModuleType

from uwsfm._base.signals import interruption_in
from uwsfm.errors import MissingPackageError

_DISTRIBUTIONS = {"rerun": "rerun-sdk"}
_LIBRARIES = {"open3d": "libusb-1.0-0 libgomp1 libgl1 libegl1 libx11-6"}
"""What apt calls the system libraries that a package needs."""
_INSTALL = "pip install '.[{extra}]' in the source folder of uwsfm"
"""Not by name: the package index may hold another project under it."""
_NO_LIBRARY = re.compile(r"(\S+): cannot open shared object file")


def import_package(name: str, purpose: str, extra: str) -> ModuleType:
    """A package that may be missing.

    Args:
        name: of the module.
        purpose: what needs it, as the start of a sentence.
        extra: of this package that installs it.

    Raises:
        MissingPackageError: it cannot be imported; names the package or the system
            library that is missing.
    """
    try:
        return import_module(name)
    except (ImportError, OSError) as error:
        interruption = interruption_in(error)
        if interruption is not None:
            raise interruption from None
        package = _DISTRIBUTIONS.get(name, name)
        library = _NO_LIBRARY.search(str(error))
        if library is not None:
            known = _LIBRARIES.get(name)
            advice = "" if known is None else f" (apt install {known})"
            missing = f"the system library {library[1]}{advice} for package {package}"
        elif isinstance(error, ModuleNotFoundError) and error.name is not None:
            module = error.name.partition(".")[0]
            found = _DISTRIBUTIONS.get(module, module)
            missing = f"the package {found}: {_INSTALL.format(extra=extra)}"
        else:
            missing = f"the package {package}, but importing it failed: {error}"
        raise MissingPackageError(f"{purpose} needs {missing}") from error
