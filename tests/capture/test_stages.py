"""Source of truth: stages that are started, interrupted and finished here."""

import pytest

from hyperplanes.capture.stages import Stages, fingerprint


def test_a_finished_stage_is_not_done_again(tmp_path):
    stages = Stages(tmp_path)
    assert stages.begin("masks", "a") is None
    (tmp_path / "masks" / "0.png").write_bytes(b"0")
    stages.finish("masks", "a", {"count": 1})
    assert Stages(tmp_path).begin("masks", "a") == {"count": 1}


def test_an_interrupted_stage_keeps_its_files_unless_its_key_changes(tmp_path):
    stages = Stages(tmp_path)
    stages.begin("masks", "a")
    (tmp_path / "masks" / "0.png").write_bytes(b"0")
    assert stages.begin("masks", "a") is None
    assert (tmp_path / "masks" / "0.png").exists()
    assert stages.begin("masks", "b") is None
    assert not (tmp_path / "masks" / "0.png").exists()
    assert stages.key("masks") == "b"


def test_a_stage_that_is_interrupted_while_its_old_files_are_deleted_is_not_done(tmp_path, monkeypatch):
    stages = Stages(tmp_path)
    stages.begin("masks", "a")
    (tmp_path / "masks" / "0.png").write_bytes(b"0")
    stages.finish("masks", "a", {"count": 1})

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hyperplanes.capture.stages.write_json", interrupted)
        with pytest.raises(KeyboardInterrupt):
            stages.begin("masks", "b")
    assert stages.begin("masks", "a") is None


def test_fingerprints_of_different_inputs_differ():
    assert fingerprint("a", 1) == fingerprint("a", 1)
    assert fingerprint("a", 1) != fingerprint("a", 2)
