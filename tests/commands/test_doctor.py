"""Source of truth: renderers and packages that are taken away, and the remedy that must then be named."""

import sys

import pytest

from data_gen.rendering import renderers
from data_gen.rendering.renderers import ProbeResult
from hyperplanes.cli import main
from hyperplanes.commands import checks as doctor
from hyperplanes.commands.checks import Check, examine, healthy

WORKING = [
    ProbeResult("pyrender-egl", False, 1.0, "no libEGL", "apt-get install -y libegl1 libgl1"),
    ProbeResult("embree", True, 1.0, "Embree ray casting", ""),
]
NONE = [ProbeResult("embree", False, 1.0, "no module named embreex", "pip install embreex")]


def test_optional_parts_may_be_missing(monkeypatch, capsys):
    monkeypatch.setattr(renderers, "probe_all", lambda: WORKING)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name in doctor.OPTIONAL else object())
    assert main(["doctor"]) == 0
    shown = capsys.readouterr().out
    assert "apt-get install -y libegl1 libgl1" in shown
    assert "pip install ray" in shown
    assert "embree draws" in shown


def test_no_renderer_is_a_broken_machine(monkeypatch, capsys):
    monkeypatch.setattr(renderers, "probe_all", lambda: NONE)
    assert main(["doctor"]) == 1
    said = capsys.readouterr()
    assert "pip install embreex" in said.out
    assert "renderer" in said.err


def test_a_missing_package_is_named_and_nothing_else_is_tried(monkeypatch):
    monkeypatch.setattr(renderers, "probe_all", lambda: pytest.fail("probed"))
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "kornia" else object())
    checks = examine()
    assert not healthy(checks)
    (broken,) = [check for check in checks if check.needed and not check.works]
    assert broken.remedy == "pip install kornia"


def test_a_torch_that_does_not_load(monkeypatch):
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


def test_health_asks_only_for_what_is_needed():
    assert healthy([Check("a", True, True, ""), Check("b", False, False, "")])
    assert not healthy([Check("a", False, True, "")])
