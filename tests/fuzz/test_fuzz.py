"""Property: a damaged file is read or refused in one line; `make fuzz` does the same with 10,000 of them."""

from tests.fuzz.campaign import run_campaign

FILES = 400


def test_damaged_files_are_read_or_refused(tmp_path):
    failures = run_campaign(range(FILES), 0, tmp_path)
    assert not failures, "\n".join(map(str, failures))
