"""Property: a damaged file is read or refused with a one-line error. `make fuzz` tests 10,000 files, and calls."""

import inspect

from tests.fuzz.calls import make_calls
from tests.fuzz.campaign import run_campaign

FILES = 400


def test_damaged_files_are_read_or_refused(tmp_path):
    failures = run_campaign(range(FILES), 0, tmp_path)
    assert not failures, "\n".join(map(str, failures))


def test_functions_take_the_arguments_of_the_campaign_of_calls(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for function, arguments in make_calls(tmp_path).values():
        inspect.signature(function).bind(**arguments)
