"""Source of truth: the verdicts in samples.csv on the sample models of Khronos (glTF-Sample-Assets) and assimp.

They are not part of the project: HYPERPLANES_MODELS names a folder with them, as a clone of either repository has them.
`drawn` is without a warning, `warned` with one that holds the message, `read` either; `refused` is a MeshError with the
message. Models with a checksum were looked at beside Khronos' pictures; the verdict of the others follows from the
extensions that they are known to use.
"""

import csv
import hashlib
import os
from pathlib import Path

import pytest

from data_gen.meshes.mesh import MeshError, load_mesh

MODELS = os.environ.get("HYPERPLANES_MODELS")
with (Path(__file__).parent / "samples.csv").open(newline="", encoding="utf-8") as table:
    SAMPLES = list(csv.DictReader(table))


def verdict(path):
    """The outcome for a model, and its warnings or error."""
    try:
        warnings = load_mesh(path).warnings
    except MeshError as error:
        return "refused", str(error)
    return "warned" if warnings else "drawn", "; ".join(warnings)


@pytest.mark.skipif(MODELS is None, reason="HYPERPLANES_MODELS names no folder of sample models")
def test_sample_models_are_drawn_with_or_without_warnings_or_refused_as_expected():
    files = {path.as_posix(): path for path in Path(MODELS).rglob("*") if path.is_file()}
    found, wrong = 0, []
    for sample in SAMPLES:
        path = next((files[name] for name in files if name.endswith("/" + sample["path"])), None)
        if path is None:
            continue
        found += 1
        if sample["sha256"] and hashlib.sha256(path.read_bytes()).hexdigest() != sample["sha256"]:
            wrong.append(f"{sample['path']}: another file than the one that was looked at")
            continue
        state, said = verdict(path)
        expected = ("drawn", "warned") if sample["verdict"] == "read" else (sample["verdict"],)
        if state not in expected or sample["message"] not in said:
            wrong.append(f"{sample['path']}: expected {sample['verdict']} {sample['message']}, found {state}: {said}")
    assert found, f"none of {len(SAMPLES)} samples is in {MODELS}"
    assert not wrong, "\n".join(wrong)


def test_the_table_is_complete():
    assert {sample["verdict"] for sample in SAMPLES} == {"drawn", "read", "refused", "warned"}
    assert len({sample["path"] for sample in SAMPLES}) == len(SAMPLES)
