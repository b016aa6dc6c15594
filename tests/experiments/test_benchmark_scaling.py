"""Lines through what was measured, and what is asked for."""

import numpy as np
import pytest

from experiments import benchmark_scaling
from represent_jax.errors import UsageError


def test_a_line_goes_through_points_on_it_and_says_how_well_it_fits():
    line = benchmark_scaling.fit_line([1, 2, 4], [5.0, 7.0, 11.0])
    np.testing.assert_allclose([line.start, line.slope, line.r_squared], [3.0, 2.0, 1.0])
    assert line.at(100) == pytest.approx(203.0)
    bent = benchmark_scaling.fit_line([1, 2, 3], [0.0, 1.0, 0.0])
    assert bent.r_squared == pytest.approx(0.0)
    assert benchmark_scaling.fit_line([1, 2], [1.0, 1.0]).r_squared == 1.0


def test_rows_say_whether_they_were_measured():
    rows, seconds, mib = benchmark_scaling.measure("horizon", [2, 4], [100], repeats=1)
    assert [row.measured for row in rows] == [True, True, False]
    assert rows[-1].seconds == seconds.at(100) and rows[-1].mib == mib.at(100)
    # Longer trajectories are larger ones.
    assert 0.0 < rows[0].mib < rows[1].mib < rows[2].mib


@pytest.mark.parametrize("text", ["seeds", "seeds:1:8", "seeds:1,x:8", "seeds:0,1:8", "seed:1,2:8"])
def test_what_cannot_be_measured_is_refused(text):
    with pytest.raises(UsageError):
        benchmark_scaling.parse(text)
