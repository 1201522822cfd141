"""What is not installed is named, a package or a library of the system."""

from pathlib import Path

import pytest

from uwsfm._base.packages import import_package
from uwsfm.errors import MissingPackageError


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        (
            None,
            "a test needs the package strange: pip install '.[inspect]' in the "
            "source folder of uwsfm",
        ),
        ("import of_strange", "a test needs the package of_strange: pip install "),
        (
            "import ctypes; ctypes.CDLL('libstrange.so.1')",  # as Open3D loads its own
            "a test needs the system library libstrange.so.1 for package strange",
        ),
        ("raise ImportError('too old')", "package strange, but importing it failed: "),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source, sentence: str
):
    monkeypatch.syspath_prepend(tmp_path)
    if source is not None:
        (tmp_path / "strange.py").write_text(source)
    with pytest.raises(MissingPackageError) as caught:
        import_package("strange", "a test", "inspect")
    assert sentence in str(caught.value)


def test_an_interrupted_import_is_no_missing_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """What pybind11 makes of Ctrl-C while a module is loaded."""
    monkeypatch.syspath_prepend(tmp_path)
    source = "raise ImportError('initialization failed') from KeyboardInterrupt()"
    (tmp_path / "interrupted.py").write_text(source)
    with pytest.raises(KeyboardInterrupt):
        import_package("interrupted", "a test", "inspect")
