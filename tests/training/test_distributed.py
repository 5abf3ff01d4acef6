"""Source of truth: a training in one process. Two processes repeat it in float64, except for rounding."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import distributed

from hyperplanes.adaptation import HyperPlanes
from hyperplanes.commands.train import Arguments, resolve
from hyperplanes.training import start_training
from hyperplanes.training.parallel.distributed import Processes, check_shares
from hyperplanes.training.parallel.launching import _leave, count_processes
from hyperplanes.utilities.files.checkpoints import load_tensors, read_json
from hyperplanes.utilities.machine.processes import is_first_process
from tests.training.two_processes import KINDS, OPTIONS, Data, normalised, weights_of

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    """The folder in which two processes trained, and the result of the first process."""
    folder = tmp_path_factory.mktemp("joined")
    begun = normalised(folder / "normalised")
    for _ in range(2):
        begun.take_step()
    begun.save()
    command = [sys.executable, "-m", "tests.training.two_processes", str(folder)]
    return folder, subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize("name", KINDS)
def test_two_processes_train_the_weights_of_one(joined, name):
    folder, _ = joined
    alone = KINDS[name]()
    list(alone.run())
    expected, before = weights_of(alone), KINDS[name]().model.state_dict()
    first, second = (load_tensors(folder / f"{name}-{rank}.safetensors") for rank in range(2))
    for key, value in expected.items():
        torch.testing.assert_close(first[key], value, rtol=1e-7, atol=1e-9)
        assert torch.equal(first[key], second[key])
    assert any((first[key] - value).abs().max() > 1e-4 for key, value in before.items())
    row = read_json(folder / "told-0.json")[name]
    assert row == pytest.approx(alone.curve[-1], rel=1e-4)


def test_a_checkpoint_of_one_process_is_resumed_in_two(joined):
    # test_two_processes_train_the_weights_of_one checks its weights; one process took two of its four steps
    folder, _ = joined
    saved = read_json(folder / "normalised" / "training.json")
    assert saved["step"] == 4
    model = HyperPlanes.from_pretrained(folder / "normalised")
    trained = load_tensors(folder / "normalised-0.safetensors")
    assert all(torch.equal(trained[key].float(), value) for key, value in model.state_dict().items())


def test_a_killed_process_ends_the_other_and_its_checkpoint_is_resumed_in_one(joined):
    folder, done = joined
    assert done.returncode in (2, -9)  # by an error, or by Fabric, which kills waiting processes
    if done.returncode == 2:
        assert done.stderr.strip().endswith(
            "another process of this training has ended; see the message of that process"
        )
    assert "shared by 2 processes" in done.stdout
    out = folder / "killed"
    assert read_json(out / "training.json")["step"] == 2
    assert not (out / ".lock").exists()
    chosen = resolve(Arguments((folder,), out, steps=6, settings=tuple(OPTIONS)))
    resumed = start_training(chosen.model, chosen.training, Data(3), out)
    assert resumed.step == 2
    list(resumed.run())
    whole = start_training(chosen.model, chosen.training, Data(3), folder / "whole")
    list(whole.run())
    assert resumed.step == whole.step == 6
    assert [row["loss"] for row in resumed.curve] == pytest.approx([row["loss"] for row in whole.curve], rel=1e-3)
    assert [row["psnr"] for row in resumed.curve] == pytest.approx([row["psnr"] for row in whole.curve], abs=0.01)


def test_a_signal_to_one_process_ends_both_after_the_same_step(joined):
    folder, _ = joined
    first, second = (read_json(folder / f"told-{rank}.json") for rank in range(2))
    assert first["step"] == second["step"] == 2
    assert first["stopped"] == "KeyboardInterrupt: step 2 is saved; run the same command again to resume from there"
    assert second["stopped"] == "none"
    assert read_json(folder / "stopped" / "training.json")["step"] == 2


def test_a_loss_that_is_not_finite_in_one_process_ends_both(joined):
    folder, _ = joined
    first, second = (read_json(folder / f"told-{rank}.json")["poisoned"] for rank in range(2))
    assert first.startswith("ValueError: step 1, on train")
    assert second.startswith("ProcessEnded: step 1, on train")
    assert "expected a finite loss, got nan" in first


def test_objects_that_cannot_be_shared_evenly_are_refused(joined):
    folder, _ = joined
    expected = (
        "tasks: expected a multiple of the 2 processes, got 3; give --training.tasks 4, or other --devices and --nodes"
    )
    assert read_json(folder / "told-1.json")["shares"] == f"ValueError: {expected}"
    with pytest.raises(ValueError, match="reference_objects: .*, got 3; give --training.reference-objects 4"):
        check_shares(4, 3, 4)


def test_the_number_of_processes_is_read_from_torchrun(monkeypatch):
    assert count_processes(3, 1) == (3, 1)
    assert is_first_process(1)
    monkeypatch.setenv("NODE_RANK", "1")
    assert is_first_process(1)  # there is no other process
    assert not is_first_process(2)
    with pytest.raises(ValueError, match="--nodes: .*NODE_RANK .0 to 1. in the environment .*, got no MASTER_ADDR"):
        count_processes(1, 2)
    monkeypatch.delenv("NODE_RANK")
    for name, value in {"TORCHELASTIC_RUN_ID": "a", "WORLD_SIZE": "6", "LOCAL_WORLD_SIZE": "3", "RANK": "4"}.items():
        monkeypatch.setenv(name, value)
    assert count_processes(1, 1) == count_processes(3, 2) == (3, 2)
    assert not is_first_process(1)
    with pytest.raises(ValueError, match="--devices: expected the 3 processes on each of 2 .*, got 2 on each of 1"):
        count_processes(2, 1)


def test_a_process_that_ends_with_an_error_leaves_its_group():
    distributed.init_process_group("gloo", store=distributed.HashStore(), rank=0, world_size=1)
    _leave()
    assert not distributed.is_initialized()
    _leave()  # also without a group


def test_shares_together_are_all_values_in_order():
    values = list(range(12))
    for count in (1, 2, 3, 4, 6):
        assert [each for rank in range(count) for each in Processes(rank, count).share(values)] == values
