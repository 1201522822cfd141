"""SHA256SUMS: whether files are those that were written, as `sha256sum --check`."""

import hashlib
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from uwsfm._base.files import replaced_file
from uwsfm.errors import InputError

SUMS = "SHA256SUMS"
_BLOCK = 2**20


def sha256(path: Path) -> str:
    """Of a file's bytes, in hexadecimal.

    Raises:
        InputError: it cannot be read.
    """
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(_BLOCK):
                digest.update(block)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return digest.hexdigest()


def write_checksums(folder: Path, paths: Iterable[Path]) -> None:
    """Write SHA256SUMS into a folder.

    Args:
        folder: where the list goes.
        paths: of files below it.
    """
    names = sorted(path.relative_to(folder).as_posix() for path in paths)
    lines = [f"{sha256(folder / name)}  {name}\n" for name in names]
    with replaced_file(folder / SUMS) as partial:
        partial.write_text("".join(lines), encoding="utf-8")


def check_checksums(path: Path) -> None:
    """Hold a file, or the files of a folder, against the list in the folder above.

    Without a list, or for what it does not name, nothing is checked: results of
    earlier versions have none.

    Raises:
        InputError: a file of the list is missing, or its content is another.
    """
    try:
        lines = (path.parent / SUMS).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        expected, _, name = line.partition("  ")
        if PurePosixPath(name).parts[:1] != (path.name,):
            continue
        file = path.parent / name
        if not file.exists():
            raise InputError(
                f"{file} is missing, but {SUMS} lists it: not all of the result was "
                "copied; copy it again"
            )
        if sha256(file) != expected:
            raise InputError(
                f"{file} is not the file that the run wrote ({SUMS}): it was copied "
                "only in part, or changed, or a later run was stopped; copy the result "
                "again, or run the command that made it again"
            )
