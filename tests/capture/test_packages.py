"""Source of truth: fake packages that raise known errors on import."""

import pytest

from hyperplanes.capture.packages import require, stated_threads

WRAPPED = """
try:
    raise {raised}
except {raised}:
    try:
        raise ImportError("initialization failed")
    except ImportError as error:
        raise RuntimeError("Cannot import\\nthe backend") from error
"""
"""pybind11 and pycolmap raise errors of their import in this way."""


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("import no_such_library", "No module named 'no_such_library'"),
        (WRAPPED.format(raised="OSError"), "initialization failed"),
        ("raise RuntimeError('two\\nlines')", "two lines"),
    ],
)
def test_a_package_that_cannot_be_imported_is_named_in_one_line(code, found, tmp_path, monkeypatch):
    (tmp_path / "broken_package.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match="expected the package broken_package, which does it, found") as raised:
        require("broken_package", "does it")
    assert str(raised.value).endswith(f"found {found}; pip install 'hyperplanes[photos]'")


def test_a_package_that_is_not_installed_is_named_as_absent():
    with pytest.raises(ValueError, match=r"expected the package absent_package, which does it, found none; pip"):
        require("absent_package", "does it")


def test_a_keyboard_interrupt_during_an_import_is_raised(tmp_path, monkeypatch):
    (tmp_path / "interrupted_package.py").write_text(WRAPPED.format(raised="KeyboardInterrupt"))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        require("interrupted_package", "does it")


@pytest.mark.parametrize(("stated", "threads"), [("4", 4), ("4,2", 4), ("", 0), ("many", 0)])
def test_the_number_of_threads_comes_from_the_environment(stated, threads, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    assert stated_threads() == threads
