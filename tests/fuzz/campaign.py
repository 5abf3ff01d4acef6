"""Damage a file, and check that it is read or refused with a one-line error in a limited time.

Case number i of a seed is always the same: `python -m tests.fuzz --seed SEED --only i` repeats it.
"""

import random
import shutil
import signal
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hyperplanes.utilities.files.reading import DataError
from tests.fuzz.corpus import CORPUS
from tests.fuzz.mutations import mutate

SECONDS = 20  # of processor time, after which a reader is considered to hang


class Hang(BaseException):
    """Raised in a reader after the time limit."""


@dataclass(frozen=True)
class Failure:
    """A case that failed, such as a damaged file that was neither read nor refused with a one-line error."""

    case: int
    kind: str
    file: str
    what: str

    def __str__(self):
        return f"case {self.case}: {self.kind}, {self.file}: {self.what:.300}"


@contextmanager
def time_limit():
    def stop(*_):
        raise Hang

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def judge(read, folder):
    """The failure of reading this input, as text; None if it was read or refused with a one-line error."""
    from data_gen.meshes.files import MeshError

    try:
        with time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            read(folder)
    except Hang:
        return f"not done after {SECONDS} s"
    except (DataError, MeshError) as error:
        text = str(error)
        return f"several lines: {text!r}" if "\n" in text else None if text else "an empty message"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def prepare(home, kinds=None):
    """Write undamaged inputs of these kinds, each to its own folder, and check that each is read."""
    made = {}
    for kind, (make, pattern, read) in CORPUS.items():
        if kinds is not None and kind not in kinds:
            continue
        folder = home / kind
        make(folder)
        files = sorted(path.relative_to(folder) for path in folder.glob(pattern) if path.is_file())
        made[kind] = (folder, files, read)
        if (wrong := judge_whole(read, folder)) is not None:
            raise AssertionError(f"{kind}: a whole input was not read: {wrong}")
    return made


def judge_whole(read, folder):
    try:
        read(folder)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def run_campaign(cases, seed, home: Path, kinds=None, report=lambda failure: None):
    """Run these cases.

    Args:
        cases: numbers of the cases.
        seed: seed of the campaign.
        home: an empty folder to work in.
        kinds: kinds of files, as named in the corpus; all if None.
        report: called with each failure when it is found.

    Returns:
        One `Failure` for each case that failed.
    """
    made = prepare(home / "whole", kinds)
    failures = []
    for case in cases:
        draw = random.Random(f"{seed} {case}")
        kind = draw.choice(sorted(made))
        folder, files, read = made[kind]
        file = draw.choice(files)
        before = (folder / file).read_bytes()
        (folder / file).write_bytes(mutate(before, file.name, draw))
        wrong = judge(read, folder)
        if wrong is not None:
            failures.append(Failure(case, kind, str(file), wrong))
            report(failures[-1])
            shutil.copy(folder / file, home / f"case-{case}-{file.name}")
        (folder / file).write_bytes(before)
    return failures
