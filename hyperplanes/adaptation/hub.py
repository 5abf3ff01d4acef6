"""Checkpoints on the Hugging Face hub, with the optional package huggingface_hub: `pip install 'hyperplanes[hub]'`."""

from __future__ import annotations

import importlib.util
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

from hyperplanes.utilities.files.checkpoints import CheckpointError
from hyperplanes.utilities.messages.errors import MissingPackageError

__all__ = ["download_checkpoint", "is_repository", "upload_checkpoint"]

FILES = ("model.json", "model.safetensors")
REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
INSTALL = "pip install 'hyperplanes[hub]'"


def is_repository(name: str) -> bool:
    """Whether a name refers to the hub: it has the form user/model, and there is no such path here."""
    return REPOSITORY.fullmatch(name) is not None and not Path(name).exists()


def download_checkpoint(name: str) -> Path:
    """The folder in huggingface_hub's cache with the checkpoint of a repository.

    Args:
        name: user/model.

    Raises:
        CheckpointError: the repository is missing, the hub cannot be reached, or huggingface_hub is not installed.
    """
    if not _is_installed():
        raise CheckpointError(
            f"{name}: expected a checkpoint's folder, found no such folder; `hyperplanes train` writes one, and "
            f"a model on the Hugging Face hub needs huggingface_hub: {INSTALL}"
        )
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(name, allow_patterns=list(FILES)))
    except Exception as error:  # the package raises its own, those of its HTTP library, OSError and ValueError
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise CheckpointError(
            f"{name}: expected a checkpoint's folder or a model on the Hugging Face hub, found neither: {reason}"
        ) from error


def upload_checkpoint(save: Callable[[Path], None], name: str, *, private: bool, message: str) -> str:
    """Write a checkpoint to a repository, which is created if absent.

    Args:
        save: writes the checkpoint to a folder.
        name: user/model.
        private: for a repository that is created.
        message: of the commit.

    Returns:
        The address of the commit.

    Raises:
        ValueError: a name of another form.
        MissingPackageError: huggingface_hub is not installed.
    """
    if not REPOSITORY.fullmatch(name):
        raise ValueError(f"repository: expected user/model, got {name!r}")
    if not _is_installed():
        raise MissingPackageError(f"push_to_hub: expected the package huggingface_hub, found none; {INSTALL}")
    from huggingface_hub import HfApi

    api = HfApi()
    api.create_repo(name, private=private, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        save(Path(folder))
        return str(api.upload_folder(repo_id=name, folder_path=folder, commit_message=message))


def _is_installed() -> bool:
    return importlib.util.find_spec("huggingface_hub") is not None
