"""What an identification compiles once it has searched, compiled by another process meanwhile."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from sysid.engine.filter_settings import FilterSettings
from sysid.engine.simulation import BatchSimulator, noisy_inputs
from sysid.fitting.reactions import with_reactions
from sysid.judging.disturbed import DisturbedRun
from sysid.problem.data import Dataset
from sysid.problem.model import ModelError, ProcessModel
from sysid.threads import Workers

_SAMPLES = 32


def compile_ahead(model: ProcessModel, record: Dataset) -> None:
    """Leave in the cache folder what a fit to a record needs behind its search.

    A filter for noise of its inputs, plain simulations of outputs that are means over windows, and
    the intervals by which score tests tell what may be missing. The search's own kernels are left
    to the search.

    >>> from sysid.examples import lag, lag_record
    >>> compile_ahead(lag(), lag_record())
    """
    simulator = BatchSimulator(model, threads=1)
    vector, n_steps = model.nominal, np.ones((1, 1), dtype=np.int64)
    head = record.part(0, min(_SAMPLES, record.n_samples), record.name)
    start = head.initial_state(model)
    with suppress(ModelError):  # whatever fails is said where its result is wanted
        if noisy_inputs([head]):
            bent, noise = with_reactions(model, head, vector, start), np.ones(len(model.outputs))
            settings = [FilterSettings(noise)]
            simulator.innovations(vector[None], [bent], [noise], n_steps, [None], settings)
    with suppress(ModelError):
        DisturbedRun.free(model, vector, head, start, 1, Workers(1))
    with suppress(ModelError):
        if head.windows.size:
            simulator.errors(vector[None], [replace(head, windows=np.zeros(0))])
