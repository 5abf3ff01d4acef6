"""Source of truth: the layers of CONTRIBUTING.md, compared with all imports in the packages, also those by strings."""

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LAYERS = {
    "hyperplanes": 7,
    "hyperplanes.cli": 7,
    "hyperplanes.__main__": 7.5,
    "hyperplanes.commands": 7,
    "data_gen.commands": 7.5,
    "benchmarks": 6,
    "data_gen": 5,
    "data_gen.shapes": 5.1,
    "data_gen.meshes": 5.1,
    "data_gen.rigs": 5.2,
    "data_gen.rendering": 5.3,
    "data_gen.datasets": 5.4,
    "hyperplanes.training": 4,
    "hyperplanes.evaluation": 4,
    "hyperplanes.configuration": 2.5,
    "hyperplanes.capture": 4,
    "hyperplanes.methods": 4,
    "hyperplanes.commands.checks": 4,
    "hyperplanes.experiments": 4.5,
    "hyperplanes.adaptation": 3,
    "hyperplanes.data": 3,
    "hyperplanes.export": 3.2,
    "hyperplanes.fields": 2,
    "hyperplanes.rendering": 2,
    "hyperplanes.views": 2,
    "hyperplanes.geometry": 1,
    "hyperplanes.hypernetwork": 1,
    "hyperplanes.adaptation.optimisation.optimisers": 1,
    "hyperplanes.parameters": 1,
    "hyperplanes.utilities": 0.5,
}
INSIDE = {  # from the lowest to the highest; modules that are not listed are below all of these
    "hyperplanes.data": ("pictures", "formats", "dataset", "inspection"),
    "hyperplanes.adaptation": (
        *("baselines", "symmetry", "network", "optimisation", "alignment", "correction", "fine_tuning", "hyperplanes"),
        *("diagnostics", "fine_tuned", "swapped"),
    ),
    "hyperplanes.geometry": ("kernels", "lookup", "image_planes", "symmetry", "visibility"),
}
OURS = ("hyperplanes", "data_gen", "benchmarks")
NAMED = re.compile(r"(hyperplanes|data_gen|benchmarks)(\.[a-z]\w*)+(:\w+|\.)?")
"""A string that names a module or one of its objects, or begins such a name in an f-string."""


@cache
def unit(module):
    """The entry of LAYERS that a module belongs to: its own name or that of its package."""
    parts = module.split(".")
    while parts:
        name = ".".join(parts)
        if name in LAYERS and (name != "hyperplanes" or module == "hyperplanes"):
            return name
        parts.pop()
    return None


@cache
def modules():
    """(name, path) of all modules of these packages."""
    paths = [path for package in OURS for path in sorted((ROOT / package).rglob("*.py"))]
    names = [".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return list(zip(names, paths, strict=True))


@cache
def examined(path):
    """The modules that a file imports, at its top, in a function or by a string, and whether it defines `__all__`.

    The syntax trees are not cached, because they would slow down garbage collection.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return list(_imported(path, tree)), _says_what_is_public(path, tree)


def imported(path):
    return examined(path)[0]


def _says_what_is_public(path, tree):
    defines = any(isinstance(node, ast.FunctionDef | ast.ClassDef | ast.ImportFrom) for node in tree.body)
    assigned = [ast.unparse(node.targets[0]) for node in tree.body if isinstance(node, ast.Assign)]
    return not defines or "__all__" in assigned or path.name == "__main__.py"


def _imported(path, tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and NAMED.fullmatch(node.value):
            name = node.value.partition(":")[0].removesuffix(".")
            if is_module(name):  # not the name of a group of entry points
                yield name
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield whole if unit(whole) != unit(node.module) else node.module


def is_module(name):
    return is_package(name) or (ROOT / Path(*name.split("."))).with_suffix(".py").is_file()


def is_package(name):
    return (ROOT / Path(*name.split("."))).is_dir()


def test_every_module_has_a_layer():
    assert [name for name, _ in modules() if unit(name) is None] == []


def test_imports_run_down():
    """Packages of the same layer, such as rendering and fields, do not import each other."""
    assert LAYERS["hyperplanes.rendering"] == LAYERS["hyperplanes.fields"]
    wrong = []
    for name, path in modules():
        here = unit(name)
        if name == "hyperplanes" or here is None:  # the top package imports everything lazily
            continue
        for target in imported(path):
            there = unit(target) if target.split(".")[0] in OURS else None
            if there is None or there == here:
                continue
            siblings = LAYERS[there] == LAYERS[here] and is_package(there) and is_package(here)
            if LAYERS[there] > LAYERS[here] or siblings:
                wrong.append(f"{name} (layer {LAYERS[here]}) imports {target} (layer {LAYERS[there]})")
    assert wrong == []


def test_imports_run_down_inside_a_package():
    for package, order in INSIDE.items():
        level = {f"{package}.{name}": index for index, name in enumerate(order)}
        for name, path in modules():
            part = ".".join(name.split(".")[:3])
            for target in imported(path) if part in level else ():
                there = level.get(".".join(target.split(".")[:3]), 0)
                assert there <= level[part], f"{name} imports {target}"


def test_hyperplanes_never_imports_data_gen():
    for name, path in modules():
        if name.split(".")[0] == "hyperplanes":
            assert not [target for target in imported(path) if target.split(".")[0] == "data_gen"], name


def test_every_module_defines_all():
    assert [name for name, path in modules() if not examined(path)[1]] == []
