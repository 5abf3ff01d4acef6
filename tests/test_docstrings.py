"""Examples in docstrings print what they say."""

import ast
import doctest
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(path for package in ("hyperplanes", "data_gen") for path in (ROOT / package).rglob("*.py"))
WITH_EXAMPLES = [path.relative_to(ROOT) for path in FILES if ">>> " in path.read_text("utf-8")]


@pytest.mark.parametrize("path", WITH_EXAMPLES, ids=str)
def test_examples_in_docstrings_are_true(path):
    module = import_module(".".join(path.with_suffix("").parts).removesuffix(".__init__"))
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    nodes = [node for node in ast.walk(ast.parse((ROOT / path).read_text("utf-8"))) if isinstance(node, documented)]
    told, runner = [], doctest.DocTestRunner()
    for node in nodes:
        text, name = ast.get_docstring(node) or "", getattr(node, "name", "module")
        example = doctest.DocTestParser().get_doctest(text, dict(vars(module)), name, str(path), 0)
        runner.run(example, out=told.append)
    assert runner.tries > 0
    assert not runner.failures, "".join(told)
