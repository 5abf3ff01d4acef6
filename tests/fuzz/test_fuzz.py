"""Property: a damaged file is read or refused with a one-line error. `make fuzz` tests 10,000 files."""

from tests.fuzz.campaign import run_campaign

FILES = 400


def test_damaged_files_are_read_or_refused(tmp_path):
    failures = run_campaign(range(FILES), 0, tmp_path)
    assert not failures, "\n".join(map(str, failures))
