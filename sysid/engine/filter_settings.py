"""What a filter assumes of a record's noise, and how it takes outputs in."""

from dataclasses import dataclass

from sysid.arrays import FloatArray


@dataclass(frozen=True)
class FilterSettings:
    """Of one record; a number stands for all of an array. That of the inputs is the record's own.

    noise: (n_outputs,), standard deviations of the outputs. scatter: (n_samples, n_outputs),
    variances that single samples have beside that. shift: of that shape, what a mean is more that
    was a deviation later than it is taken for, whose square is a part of scatter; jitter_colour: of
    that shape, how much of how late the sample before was goes on, 1 to those that were not
    measured. trust: of that shape, factors of the innovations, though all are taken in. process:
    (n_states,), intensities of the process's noise, standard deviations of the states' rates over
    the root of a second. colour: (n_inputs,), parts of the inputs' noise that go on from sample to
    sample. corrects: whether outputs correct the states; else innovations are those of the free
    run. exact: whether averaged outputs are what free runs say, not taken for parabolas between
    samples.

    >>> import numpy as np
    >>> FilterSettings(np.array([0.1]), process=0.5).corrects
    True
    """

    noise: FloatArray
    scatter: FloatArray | float = 0.0
    shift: FloatArray | float = 0.0
    jitter_colour: FloatArray | float = 0.0
    trust: FloatArray | float = 1.0
    process: FloatArray | float = 0.0
    colour: FloatArray | float = 0.0
    corrects: bool = True
    exact: bool = False
