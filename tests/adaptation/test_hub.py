"""Models on the Hugging Face hub. Source of truth: the model itself, through a fake module huggingface_hub.

Tests do not access the hub. The fake module stores files in a folder, and its functions have the signatures of the
real ones.
"""

import importlib.machinery
import shutil
import sys
import types
from pathlib import Path

import pytest
import torch

from hyperplanes.adaptation.hyperplanes import HyperPlanes, ModelConfig
from hyperplanes.fields.base import TargetConfig
from hyperplanes.utilities.files.checkpoints import CheckpointError


@pytest.fixture
def hub(tmp_path, monkeypatch):
    class HfApi:
        def create_repo(self, repo_id, *, private=None, exist_ok=False):
            (tmp_path / repo_id).mkdir(parents=True, exist_ok=exist_ok)

        def upload_folder(self, *, repo_id, folder_path, commit_message=None):
            shutil.copytree(folder_path, tmp_path / repo_id, dirs_exist_ok=True)
            return f"hub/{repo_id}/{commit_message}"

    def snapshot_download(repo_id, *, allow_patterns=None):
        if not (tmp_path / repo_id).is_dir():
            raise OSError("404 Client Error\nmore about it")
        assert {path.name for path in (tmp_path / repo_id).iterdir()} == set(allow_patterns)
        return str(tmp_path / repo_id)

    module = types.ModuleType("huggingface_hub")
    module.__spec__ = importlib.machinery.ModuleSpec("huggingface_hub", None)
    vars(module).update(HfApi=HfApi, snapshot_download=snapshot_download)
    monkeypatch.setitem(sys.modules, "huggingface_hub", module)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")


@pytest.fixture
def model():
    return HyperPlanes(ModelConfig(hypernetwork=None, network=TargetConfig(planes=3, width=8, depth=2)))


def test_a_model_comes_back_from_the_hub(hub, model):
    assert model.push_to_hub("someone/a-model", message="first") == "hub/someone/a-model/first"
    again = HyperPlanes.from_pretrained("someone/a-model")
    assert again.config == model.config
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in model.state_dict().items())


def test_a_folder_has_precedence_over_the_hub(hub, model):
    other = HyperPlanes(model.config, seed=1)
    other.save_pretrained(Path("someone/a-model"))
    model.push_to_hub("someone/a-model")
    again = HyperPlanes.from_pretrained("someone/a-model")
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in other.state_dict().items())


def test_a_missing_repository_is_reported_in_one_line(hub, model):
    with pytest.raises(CheckpointError, match="found neither: 404 Client Error$"):
        HyperPlanes.from_pretrained("someone/another")
    with pytest.raises(ValueError, match="repository: expected user/model, got 'a-model'"):
        model.push_to_hub("a-model")


def test_without_the_package_the_error_says_what_to_install(model, monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RuntimeError, match=r"pip install 'hyperplanes\[hub\]"):
        model.push_to_hub("someone/a-model")
    with pytest.raises(CheckpointError, match=r"a-model: .*no such folder.*pip install 'hyperplanes\[hub\]"):
        HyperPlanes.from_pretrained("someone/a-model")
