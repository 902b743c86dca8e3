"""`fitctl figures`, before it begins to work."""

import pytest

from fitctl.cli import main


@pytest.mark.parametrize("folder", ["/proc", "/dev/null", "/proc/new"])
def test_a_folder_that_cannot_be_written_is_refused_before_minutes_of_work(folder, capsys):
    with pytest.raises(SystemExit) as end:
        main(["figures", "--quick", "--out", folder])

    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"figures: --out {folder}: no folder to write in: ")
    assert error.count("\n") == 1
