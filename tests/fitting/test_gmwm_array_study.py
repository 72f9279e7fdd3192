"""The study of matrices by moments runs, prints its tables and draws its figure."""

from pathlib import Path

import pytest
from test_papers import is_png, row, run


@pytest.mark.statistical
def test_array(tmp_path: Path):
    done = run("gmwm_array.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert is_png(tmp_path / "gmwm_array_risks.png")
    first, second = done.stdout.split("Case 2: ")
    assert "6 arrays of 65536 samples, 6 converged" in first
    assert "ar1_3.phi: median" in second
    for part in (first, second):
        equal, plain, fitted = (float(row(part, *name.split())[0]) for name in ("equal", "SVO", "array GMWM"))
        assert max(plain, fitted) < equal
    assert float(row(first, "array", "GMWM")[0]) < float(row(first, "SVO")[0]) / 2
