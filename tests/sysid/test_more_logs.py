"""More logs never determine less: the same quantities have intervals, and narrower ones."""

from __future__ import annotations

from itertools import pairwise

from sysid import GASSI, Parameter
from sysid.examples import lag_record
from tests.sysid.support import lag

GAIN = Parameter("gain", "1", 2.0, 0.2, 20.0, "log")
SENSE = Parameter("sense", "1", 1.0, 0.1, 10.0, "log")
TAU = Parameter("tau", "s", 0.05, 0.005, 0.5, "log")


def test_more_logs_never_determine_less():
    model = lag(
        parameters=(GAIN, SENSE, TAU),
        derivative=lambda x, u, p: ((p[0] * p[1] * u[0] - x[0]) / p[2],),
    )
    records = [lag_record(seed=k) for k in range(8)]
    widths = []
    for n in (1, 2, 4, 8):
        fit = GASSI(model, population=30, generations=8, random_state=0).fit(records[:n])
        determined = {e.name: e.std for e in fit.uncertainty(records[:n]).determined()}
        assert sorted(determined) == ["gain sense", "tau"]
        widths.append(determined)
    for fewer, more in pairwise(widths):
        assert all(more[name] < fewer[name] for name in more)
