"""What one process compiles ahead another finds in the cache folder."""

import json
import os
import subprocess
import sys

import pytest

FIT = """
import json, sys
from dataclasses import replace
import numpy as np
from numba.core import event
from sysid.examples import lag, lag_record
from sysid.gassi import GASSI
from sysid.judging.ahead import compile_ahead
from sysid.judging.examination import verdict_of

compiled = []

class Listener(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].py_func.__name__)

    def on_end(self, event):
        pass

record = replace(lag_record(), input_noise=np.array([0.01]))
if sys.argv[1] == "ahead":
    compile_ahead(lag(), record)
else:
    event.register("numba:compile", Listener())
    verdict_of(GASSI(lag(), population=8, generations=2, criterion="innovations").fit(record), [record])
print(json.dumps(compiled))
"""  # noqa: E501


@pytest.mark.soak
def test_what_was_compiled_ahead_a_fit_does_not_compile(tmp_path):
    environment = {**os.environ, "RIG_CACHE_DIR": str(tmp_path / "cache")}

    def run(which):
        command = [sys.executable, "-c", FIT, which]
        done = subprocess.run(command, env=environment, capture_output=True, check=True)
        return json.loads(done.stdout)

    run("ahead")
    compiled = run("fit")
    # The search's own kernels are left to the search.
    assert "simulate" in compiled and not {"innovations", "levels", "advance"} & set(compiled)
    assert run("fit") == []
