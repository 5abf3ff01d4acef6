"""One tiny demonstration, made once for all tests that want its data set, checkpoints and page."""

import atexit
import functools
import shutil
import tempfile
from pathlib import Path

from hyperplanes.cli import main


@functools.cache
def demo_folder():
    """The folder of `hyperplanes demo --quick-check`."""
    folder = Path(tempfile.mkdtemp(prefix="hyperplanes-demo-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    assert main(["demo", "--quick-check", "--out", str(folder)]) == 0
    return folder


def first_object(folder):
    """The folder of the first held-out object."""
    return min(path for path in (folder / "data").iterdir() if "test" in path.name)
