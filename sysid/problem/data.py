"""Uniformly sampled records that a process model is fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sysid.arrays import FloatArray
from sysid.problem.channels import noise
from sysid.problem.model import AROUND_FIRST_SAMPLE, ModelError, ProcessModel

_LARGEST = 1e100  # of a sample: far beyond, squares are infinite
_SAME_RATE = 1e-3  # of a sample time


@dataclass(frozen=True, repr=False)
class Dataset:
    """A record: row k holds the outputs latched at time k*dt and the inputs from then on.

    inputs: (n_samples, n_inputs); outputs: (n_samples, n_outputs), NaN where a sample was
    lost, so that a gap keeps its length in time. SI units, columns in the model's order.
    input_zero, output_zero: (n_inputs,) and (n_outputs,), standard deviation of a constant error
    that the channel may have had throughout, as an offset calibration leaves it; input_noise:
    (n_inputs,), standard deviation of the white noise on measured inputs; they widen the intervals
    of what is identified. output_noise: (n_outputs,), that of the outputs, below which no model's
    errors can be; 0 where it is not known. windows: (n_samples, n_outputs, 2), the time over which
    a sensor averaged each sample of an output, its begin and end in seconds from the sample on;
    both 0 where it was sampled at its instant. Simulated outputs are averaged alike. jitter:
    (n_samples, n_outputs), standard deviation of when each window was [s]; jitter_colour: of that
    shape, correlation of its error with that of the window before. between: (n_samples,
    n_inputs), by how much the mean of an interpolated input up to the next sample differs from that
    of a straight line, for which filters bend it. changes: (n_samples, n_inputs), by how much a
    held input changes before the next sample; last_part: (n_inputs,), part of the time up to that
    for which it is the later value; such inputs are means over that time. Default none. begin:
    instant of the first row as whoever made the record counts time [s]. cut: whether it was cut
    from a longer record amid its motion, so that states whose first sample is a mean over the time
    before start elsewhere. log: of a part of a longer record the number of that, whose channels'
    zeros all of its parts share; None of a whole one. planned: whether its exact inputs are known
    to have been planned, so that none of them answers an output.

    Raises ModelError for mismatched shapes, fewer than two rows, complex numbers, inputs that are
    not finite, infinite outputs, or numbers beyond 1e100.

    >>> record = Dataset(inputs=np.ones(5), outputs=np.arange(5.0), dt=0.01, name="ramp")
    >>> record.n_samples, record.outputs.shape
    (5, (5, 1))
    """

    inputs: FloatArray
    outputs: FloatArray
    dt: float
    name: str = "data"
    input_zero: FloatArray = field(default_factory=lambda: np.zeros(0))
    output_zero: FloatArray = field(default_factory=lambda: np.zeros(0))
    input_noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    output_noise: FloatArray = field(default_factory=lambda: np.zeros(0))
    windows: FloatArray = field(default_factory=lambda: np.zeros(0))
    jitter: FloatArray = field(default_factory=lambda: np.zeros(0))
    jitter_colour: FloatArray = field(default_factory=lambda: np.zeros(0))
    between: FloatArray = field(default_factory=lambda: np.zeros(0))
    changes: FloatArray = field(default_factory=lambda: np.zeros(0))
    last_part: FloatArray = field(default_factory=lambda: np.zeros(0))
    begin: float = 0.0
    cut: bool = False
    log: int | None = None
    planned: bool = False

    def __repr__(self) -> str:
        size = f"{self.n_samples} samples, dt={self.dt:g} s"
        signals = f"{self.inputs.shape[1]} in, {self.outputs.shape[1]} out"
        return f"<Dataset: {self.name}, {size}, {signals}>"

    def __post_init__(self) -> None:
        for name in ("inputs", "outputs"):
            object.__setattr__(self, name, self._table(name))
        if len(self.inputs) != len(self.outputs):
            raise ModelError(
                f"{self.name}: {len(self.inputs)} rows of inputs, {len(self.outputs)} of outputs"
            )
        if len(self.outputs) < 2:
            raise ModelError(f"{self.name}: it has {len(self.outputs)} row(s); at least 2 needed")
        if not (np.isfinite(self.dt) and self.dt > 0):
            raise ModelError(f"{self.name}: sample time {self.dt} s must be positive")
        self._refuse(self.inputs, "input", "mend it, or cut the record there")
        measured = np.nan_to_num(self.outputs, nan=0.0, posinf=np.inf, neginf=-np.inf)
        self._refuse(measured, "output", "write NaN for a sample that was lost")
        for name in ("input_zero", "output_zero", "input_noise", "output_noise"):
            object.__setattr__(self, name, self._deviations(name))
        self._check_windows()
        for name in ("between", "changes"):
            table = getattr(self, name)
            if table.size and table.shape != self.inputs.shape:
                raise ModelError(
                    f"{self.name}: {name} has shape {table.shape}; give a number for each sample "
                    f"and input: {self.inputs.shape}"
                )
        parts = self.last_part if self.changes.size else np.zeros(self.inputs.shape[1])
        if parts.shape != self.inputs.shape[1:] or not np.all((parts >= 0.0) & (parts < 1.0)):
            raise ModelError(
                f"{self.name}: last_part must hold a number from 0 to 1 for each input that has "
                f"changes: {self.inputs.shape[1:]}"
            )
        object.__setattr__(self, "last_part", parts)

    def _check_windows(self) -> None:
        """Raise ModelError for windows that are none of these outputs'."""
        if self.windows.size == 0:
            return
        if self.windows.shape != (*self.outputs.shape, 2):
            raise ModelError(
                f"{self.name}: windows have shape {self.windows.shape}; give begin and end for "
                f"each sample and output: {(*self.outputs.shape, 2)}"
            )
        begin, end = self.windows[..., 0], self.windows[..., 1]
        if not (np.isfinite(self.windows).all() and np.all(begin <= end)):
            raise ModelError(f"{self.name}: a window must begin before it ends, at finite times")
        if self.jitter.size == 0:
            object.__setattr__(self, "jitter", np.zeros(self.outputs.shape))
        if self.jitter.shape != self.outputs.shape or not np.all(
            np.isfinite(self.jitter) & (self.jitter >= 0.0)
        ):
            raise ModelError(
                f"{self.name}: jitter must hold a finite number, 0 or more, for each sample and "
                f"output: {self.outputs.shape}; it has shape {self.jitter.shape}"
            )
        if self.jitter_colour.size == 0:
            object.__setattr__(self, "jitter_colour", np.zeros(self.outputs.shape))
        colour = self.jitter_colour
        if colour.shape != self.outputs.shape or not np.all((colour >= 0.0) & (colour <= 1.0)):
            raise ModelError(
                f"{self.name}: jitter_colour must hold a number from 0 to 1 for each sample and "
                f"output: {self.outputs.shape}; it has shape {colour.shape}"
            )

    def _table(self, name: str) -> FloatArray:
        """Inputs or outputs as real numbers, (n_samples, n); ModelError where they are others."""
        given = np.asarray(getattr(self, name))
        if np.iscomplexobj(given):
            raise ModelError(f"{self.name}: {name} are complex; give real numbers, such as .real")
        try:
            table = np.ascontiguousarray(given, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ModelError(f"{self.name}: {name} are not numbers: {error}") from None
        if table.ndim not in (1, 2):
            raise ModelError(f"{self.name}: {name} have shape {table.shape}; give (n_samples, n)")
        return table.reshape(-1, 1) if table.ndim == 1 else table

    def _refuse(self, table: FloatArray, kind: str, cure: str) -> None:
        """Raise ModelError at the first entry of a table that is no measurement, if any."""
        wrong = ~(np.abs(table) <= _LARGEST)
        if wrong.any():
            row, column = np.argwhere(wrong)[0].tolist()
            what = "beyond 1e100" if np.isfinite(table[row, column]) else "not finite"
            raise ModelError(
                f"{self.name}: {kind} {column} is {what} in row {row}, counted from 0; {cure}"
            )

    def _deviations(self, name: str) -> FloatArray:
        """Standard deviations of a side's channels; zeros where none are given."""
        n = (self.inputs if name.startswith("input") else self.outputs).shape[1]
        given = np.asarray(getattr(self, name), dtype=np.float64)
        deviations = given if given.size else np.zeros(n)
        if deviations.shape != (n,) or not np.all(np.isfinite(deviations) & (deviations >= 0.0)):
            raise ModelError(
                f"{self.name}: {name} must hold {n} finite numbers, 0 or more: one standard "
                "deviation for each channel"
            )
        return deviations

    @property
    def n_samples(self) -> int:
        """Number of rows."""
        return len(self.outputs)

    @property
    def time(self) -> FloatArray:
        """Sample instants [s], shape (n_samples,)."""
        return self.dt * np.arange(self.n_samples, dtype=np.float64)

    def part(self, begin: int, end: int, name: str) -> Dataset:
        """The rows from ``begin`` up to ``end`` as a record."""
        rows = slice(begin, end)
        return replace(
            self,
            inputs=self.inputs[rows],
            outputs=self.outputs[rows],
            windows=self.windows[rows],
            jitter=self.jitter[rows],
            jitter_colour=self.jitter_colour[rows],
            between=self.between[rows],
            changes=self.changes[rows],
            name=name,
            begin=self.begin + begin * self.dt,
        )

    def check(self, model: ProcessModel) -> None:
        """Raise ModelError unless the columns match the model's inputs and outputs."""
        expected = (len(model.inputs), len(model.outputs))
        columns = (self.inputs.shape[1], self.outputs.shape[1])
        if columns != expected:
            raise ModelError(
                f"{self.name}: {columns[0]} inputs and {columns[1]} outputs, but model "
                f"{model.name} has {expected[0]} and {expected[1]}"
            )

    def initial_state(self, model: ProcessModel) -> FloatArray:
        """Start of a free run: states that are outputs from the first row, others as declared.

        Shape (n_states,). A state with ``first_sample`` off starts as declared all the same.
        """
        x0 = model.initial_state
        first = dict(zip(model.output_names, self.outputs[0], strict=True))
        for i, state in enumerate(model.states):
            if state.first_sample and np.isfinite(first.get(state.name, np.nan)):
                x0[i] = first[state.name]
        return x0

    def sample_noise(self, output: int, residual: FloatArray) -> float:
        """Standard deviation of an output's noise: as calibrated, else as residuals (n,) show it.

        Of a signal that moves fast its samples do not show it, but what a model leaves of them.
        """
        return float(self.output_noise[output]) or noise(residual)

    def starts_at_samples(self, model: ProcessModel) -> list[int | None]:
        """For each state the output whose first sample it starts at, None where it does not."""
        places: list[int | None] = []
        for i, state in enumerate(model.states):
            named = state.name in model.output_names
            j = model.output_names.index(state.name) if named else None
            measured = j is not None and np.isfinite(self.outputs[0, j])
            estimated = self.initial_range(model, i) is not None
            places.append(j if measured and state.first_sample and not estimated else None)
        return places

    def initial_range(self, model: ProcessModel, state: int) -> tuple[float, float] | None:
        """Range in which a state's initial value is estimated; None where it is not."""
        declared = model.states[state].initial_range
        if declared is None and self.cut and self._averaged_at_first(model, state):
            declared = AROUND_FIRST_SAMPLE
        if declared != AROUND_FIRST_SAMPLE:
            return declared
        values = self.outputs[:, model.output_names.index(model.state_names[state])]
        values = values[np.isfinite(values)]
        middle = float(self.initial_state(model)[state])
        span = (float(np.ptp(values)) if len(values) else 0.0) or 1.0
        return middle - span, middle + span

    def _averaged_at_first(self, model: ProcessModel, state: int) -> bool:
        """Whether the first sample of a state is a mean over a window before it."""
        name = model.state_names[state]
        if name not in model.output_names or not self.windows.size:
            return False
        j = model.output_names.index(name)
        begin, end = self.windows[0, j]
        return bool(np.isfinite(self.outputs[0, j]) and begin < end)


def require_information(datasets: list[Dataset], names: Sequence[str], n_free: int) -> None:
    """Raise ModelError for records that determine nothing.

    names: of the outputs. n_free: how many numbers are to be fitted. A first row tells where a
    simulation starts, and no more; an output that never changes has no deviation to explain.
    """
    outputs = np.concatenate([record.outputs for record in datasets])
    n_values = sum(int(np.isfinite(record.outputs[1:]).sum()) for record in datasets)
    where = ", ".join(record.name for record in datasets[:3]) + ", ..." * (len(datasets) > 3)
    if n_values <= n_free:
        raise ModelError(
            f"{where}: too short: after its first sample it has {n_values} measured "
            f"value{'s' * (n_values != 1)}, for {n_free} unknown{'s' * (n_free != 1)}; give a "
            "longer record, or fix parameters"
        )
    lowest = np.where(np.isfinite(outputs), outputs, np.inf).min(axis=0)
    highest = np.where(np.isfinite(outputs), outputs, -np.inf).max(axis=0)
    if np.all(highest <= lowest):
        measured = [(n, v) for n, v in zip(names, highest, strict=True) if np.isfinite(v)]
        values = ", ".join(f"{name} is {value:g}" for name, value in measured)
        raise ModelError(
            f"{where}: {values} throughout, so that there is no deviation to explain; was the "
            "sensor connected, is it the right column? Else excite the system"
        )


def output_scale(datasets: list[Dataset], per_log: bool = False) -> list[FloatArray]:
    """max|y| of each output, the unit of (4.22) and of tables 4.2 and 4.3.

    An (n_outputs,) array for each dataset: its maximum with ``per_log``, else the maximum over
    all of them. An output that never leaves zero gets 1.

    >>> runs = [Dataset(np.zeros(2), np.array([0.0, peak]), 0.01) for peak in (-3.0, 2.0)]
    >>> [scale.tolist() for scale in output_scale(runs)]
    [[3.0], [3.0]]
    """
    measured = [np.where(np.isfinite(d.outputs), np.abs(d.outputs), 0.0) for d in datasets]
    peaks = np.array([values.max(axis=0) for values in measured])
    if not per_log:
        peaks = np.broadcast_to(peaks.max(axis=0), peaks.shape)
    return [np.where(peak > 0.0, peak, 1.0) for peak in peaks]


def of_one_rate(records: Sequence[Dataset]) -> bool:
    """Whether records have one sample time; times that logs print make it a little uneven.

    >>> of_one_rate([Dataset(np.zeros(2), np.zeros(2), dt) for dt in (0.001, 0.00099999)])
    True
    """
    return bool(np.allclose([record.dt for record in records], records[0].dt, rtol=_SAME_RATE))
