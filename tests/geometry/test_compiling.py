"""Source of truth: a property: numba unpickles cached machine code, so no other user may write to its folder."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest


@pytest.fixture
def cache_folder(tmp_path, monkeypatch):
    from numba.core import config

    from hyperplanes.geometry.kernels import compiling

    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path), raising=False)
    return compiling._cache_folder.__wrapped__


def test_the_cache_belongs_to_this_user_only(tmp_path, cache_folder):
    open_to_all = tmp_path / "hyperplanes"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    found = Path(cache_folder())
    assert found.parent == open_to_all
    for part in (found, found.parent):
        assert part.stat().st_mode & 0o777 == 0o700
        assert part.stat().st_uid == os.getuid()


def test_a_link_or_a_folder_of_another_user_is_not_used(tmp_path, cache_folder, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "hyperplanes").symlink_to(tmp_path / "elsewhere")
    with pytest.warns(UserWarning, match="not this user's alone; kernels are compiled into"):
        assert Path(cache_folder()).name.startswith("hyperplanes-kernels-")
    (tmp_path / "hyperplanes").unlink()
    (tmp_path / "hyperplanes").mkdir()
    owner = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: owner + 1)
    with pytest.warns(UserWarning, match="not this user's alone"):
        assert Path(cache_folder()).name.startswith("hyperplanes-kernels-")


def test_setup_compiles_every_kernel_without_gradients():
    from hyperplanes.geometry.kernels.__main__ import rendering_kernels
    from hyperplanes.geometry.kernels.compiling import _SIGNATURES, layers_module

    used = {f"{layers_module()}.layers", f"{layers_module(mixed_precision=True)}.layers"}
    others = {name for name in _SIGNATURES if name.startswith("layers")} - used  # for other processors
    assert set(rendering_kernels()) == {name for name in _SIGNATURES if "backward" not in name} - others


def test_concurrent_threads_compile_once_and_into_the_folder(tmp_path, monkeypatch):
    import numba
    from numba.core import config

    from hyperplanes.geometry.kernels import compiling

    folders = []

    def njit(**options):
        time.sleep(0.05)
        folders.append(config.CACHE_DIR)
        return lambda function: function

    monkeypatch.setattr(numba, "njit", njit)
    monkeypatch.setattr(compiling, "_cache_folder", lambda: str(tmp_path))
    before = config.CACHE_DIR
    with ThreadPoolExecutor(2) as pool:
        work = lambda: None  # noqa: E731 - a new function, since compiled ones are cached
        found = list(pool.map(compiling.compile_function, [work, work]))
    assert found == [work, work]
    assert folders == [str(tmp_path)]
    assert before == config.CACHE_DIR
