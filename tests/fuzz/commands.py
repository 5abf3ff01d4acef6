"""Command lines with errors in them, each run in its own process.

A valid line gets a few random options of the verb's dataclass, with valid or invalid values. Each line has to end with
exit code 0, 1 or 2, and with a one-line error if it is 2, within limits of time and memory, and without changes to its
inputs. Case number i of a seed is always the same: `python -m tests.fuzz --commands 1 --only i --seed SEED`.
"""

import faulthandler
import os
import random
import resource
import shlex
import shutil
import signal
import sys
import time
import traceback
from dataclasses import fields
from pathlib import Path
from typing import get_args, get_type_hints

from PIL import Image

from hyperplanes.commands import find_verbs
from hyperplanes.utilities.files.encoding import sha256
from tests.fuzz.campaign import Failure
from tests.fuzz.corpus import baked, colmap, data_set, meshes, pictures, posed_scene, settings, small_model

SECONDS = 120  # of processor time, after which a command is considered to hang
DEADLINE_SECONDS = 400  # seconds of waiting
MEMORY = 8 * 2**30  # bytes in addition to those of this process

OUT = "out"
MODEL = ["--checkpoint", "model", "--views", "scene"]
LINES = {
    "render": [*MODEL, "--out", OUT],
    "export": [*MODEL, "--out", OUT, "--voxels", "16", "--frames", "2", "--texture", "32", "--fit", "1"],
    "bake": [*MODEL, "--out", "out.safetensors", "--voxels", "16", "--fit", "1"],
    "adapt": [*MODEL, "--out", OUT],
    "evaluate": ["--data", "data", "--checkpoint", "model", "--method", "nearest_view", "hyperplanes"],
    "train": ["--data", "data", "--config", "small/config.yaml", "--out", OUT, "--steps", "1"],
    "inspect": ["scene", "--out", OUT],
    "presets": ["quick"],
    "generate": ["--class", "car", "--count", "1", "--resolution", "16", "--views", "2", "--out", OUT],
    "capture": ["photographs", "--out", OUT],
    "reproduce": ["layers", "--estimate", "--out", OUT],
    "demo": ["--out", "data/manifest.json"],
    "view": ["nothing", "--port", "0"],
}
LONG = {"demo", "view", "reproduce"}
"""Verbs that take long. Their lines have an option that ends them at once, which is not replaced."""

POSITIONAL = {("inspect", "path"), ("presets", "name"), ("capture", "photographs"), ("reproduce", "name")}

NUMBERS = ["0", "1", "2", "-1", "2.5", "1e3", "nan", "inf", "-inf", "", "x", "٣", "0x10", "None"]
LARGE = ["3000", "200000", "2147483648", "99999999999999999999"]
LASTS = {"steps", "epochs", "frames", "orbit", "fit", "count", "objects", "held_out", "seeds", "views", "supersample"}
"""Options for which a large number is valid but takes long."""

PLACES = [
    "model", "scene", "data", "colmap", "mesh", "mesh/a.obj", "empty", "nothing", "nothing/at/all", "", ".",
    "data/manifest.json", "model/model.safetensors", "baked/a.safetensors", "scene/images", "scene/images/0.png",
    "pipe", "/dev/null", "/dev/full", "loop", "a\nb", "x" * 300, "small/config.yaml", "photographs", "-", "out", "cut",
]  # fmt: skip
NAMES = ["quick", "paper", "hyperplanes", "nerf", "scratch_2", "hyperplanes_-1", "hyperplanes_x", "", "é", "None", "\\",
         "cpu", "meta", "cuda:7", "y", "0,0,0", "nan,0,1", "1,2", "[bold]", "%s", "{}", "a=b"]  # fmt: skip
SETTINGS = ["model.network.depth", "model.network.width", "training.steps", "training.rays", "model.target", "model.x",
            "training.evaluate_every", "training.learning_rate", ".", "a.b.c", "model.hypernetwork"]  # fmt: skip


def prepare_inputs(home):
    """Write the files that the lines name."""
    posed_scene(home / "scene")
    data_set(home / "data")
    colmap(home / "colmap", binary=True)
    meshes(home / "mesh")
    baked(home / "baked")
    settings(home / "small")
    small_model().save(home / "model")
    shutil.copytree(home / "scene", home / "cut")
    (home / "cut/transforms.json").write_text((home / "scene/transforms.json").read_text()[:-20])
    (home / "photographs").mkdir()
    for index, picture in enumerate(pictures()):
        Image.fromarray(picture[..., :3]).resize((64, 48)).save(home / f"photographs/{index}.jpg")
    (home / "empty").mkdir()
    os.mkfifo(home / "pipe")
    (home / "loop").symlink_to("loop")


def draw_line(draw):
    """A random verb with options."""
    verb = draw.choice(sorted(LINES))
    line = list(LINES[verb])
    arguments = find_verbs()[verb].load().Arguments
    hints = get_type_hints(arguments, include_extras=False)
    options = [each.name for each in fields(arguments) if each.name != "settings"]
    for _ in range(draw.choice([1, 1, 2, 3])):
        if verb == "train" and draw.random() < 0.2:
            line += [f"--{draw.choice(SETTINGS)}", draw.choice(NUMBERS + NAMES)]
            continue
        name = draw.choice(options)
        flag = "--" + {"class_name": "class", "meshes_class": "class-name"}.get(name, name).replace("_", "-")
        if verb in LONG and (flag in line or (verb, name) == ("view", "views")):
            continue
        if (verb, name) in POSITIONAL:
            line[0] = _value(name, hints[name], draw)
            continue
        several = draw.choice([1, 2]) if "tuple" in str(hints[name]) else draw.choice([1] * 19 + [2])
        values = [_value(name, hints[name], draw) for _ in range(several)]
        values = [value for value in values if value is not None]
        if flag in line and draw.random() < 0.8:
            at = line.index(flag)
            line[at + 1 : at + 2] = values
        else:
            line += [flag, *values]
    way = draw.random()
    if way < 0.04 and verb not in LONG:
        line.remove(draw.choice(line))
    elif way < 0.06:
        line.insert(draw.randrange(len(line) + 1), draw.choice([*NAMES, *PLACES, "--", "--help", "-x"]))
    return [verb, *line]


def _value(name, hint, draw):
    """A value that may match the annotation of an option; None for a flag without a value."""
    text = str(hint)
    if hint is bool:
        return None if draw.random() < 0.8 else draw.choice(["True", "x"])
    if "Literal" in text and draw.random() < 0.8:
        words = [word for part in [hint, *get_args(hint)] for word in get_args(part) if isinstance(word, str)]
        if words:
            return draw.choice(words)
    if draw.random() < 0.15:
        return draw.choice(NUMBERS + NAMES + PLACES)
    if "Path" in text:
        return draw.choice(PLACES)
    if "int" in text or "float" in text:
        return draw.choice(NUMBERS if name in LASTS else NUMBERS + LARGE)
    return draw.choice(NAMES)


def _tree(home):
    """The checksums of all files of a folder, by path."""
    return {
        str(path.relative_to(home)): sha256(path.read_bytes()) if path.is_file() else ""
        for path in sorted(home.rglob("*"))
        if not path.is_fifo()
    }


def _child(line, home, report):
    """Run one line in this process, and end the process with its exit code, or with 70 after an exception."""
    from hyperplanes.cli import main

    with open(report, "w") as told, open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
        for stream in (1, 2):
            os.dup2(told.fileno(), stream)
    sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
    os.chdir(home)
    os.setsid()
    faulthandler.enable()
    now = resource.getrusage(resource.RUSAGE_SELF)
    used = int(now.ru_utime + now.ru_stime) + SECONDS
    resource.setrlimit(resource.RLIMIT_CPU, (used, used + 5))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY,) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**30, 2**30))
    code = 70
    try:
        code = main(line)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError, AttributeError):
                pass
        os._exit(code)


def run_line(line, home, report):
    """The failure of a line, as text; None if it ended as expected."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        _child(line, home, report)
    deadline = time.monotonic() + DEADLINE_SECONDS
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"not done after {DEADLINE_SECONDS} s"
        time.sleep(0.02)
    told = report.read_text(errors="replace")
    if os.WIFSIGNALED(status):
        return f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
    code = os.WEXITSTATUS(status)
    if code == 70 or "Traceback" in told:
        return told.strip().splitlines()[-1] if told.strip() else "an exception"
    if code not in (0, 1, 2):
        return f"exit code {code}"
    error_line = told.strip().splitlines()[-1] if told.strip() else ""
    refused = error_line.startswith("hyperplanes") or "hyperplanes" in error_line and "--help" in error_line  # tyro
    if code == 2 and not refused:
        return f"exit code 2 with the last line {error_line!r}"
    if code == 2 and any(word in error_line for word in ("Error:", "object has no attribute", "not supported between")):
        return f"a line for programmers: {error_line}"
    return None


def run_commands(cases, seed, home: Path, report=lambda failure: None):
    """Run these cases.

    Args:
        cases: numbers of the cases.
        seed: seed of the campaign.
        home: an empty folder to work in.
        report: called with each failure when it is found.

    Returns:
        One `Failure` for each line that failed.
    """
    os.environ["HYPERPLANES_CACHE"] = str(home / "cache")
    whole, work = home / "whole", home / "work"
    prepare_inputs(whole)
    failures = []
    for case in cases:
        line = draw_line(random.Random(f"{seed} {case}"))
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(whole, work, symlinks=True, ignore=shutil.ignore_patterns("pipe"))
        os.mkfifo(work / "pipe")
        before = _tree(work)
        wrong = run_line(line, work, home / f"case-{case}.txt")
        after = _tree(work)
        changed = [name for name, content in before.items() if after.get(name) != content]
        if wrong is None and changed:
            wrong = f"changed {', '.join(changed[:3])}"
        if wrong is not None:
            failures.append(Failure(case, "command", shlex.join(line), wrong))
            report(failures[-1])
        else:
            (home / f"case-{case}.txt").unlink(missing_ok=True)
    return failures
