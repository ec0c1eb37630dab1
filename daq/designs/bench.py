"""A rig that is only computed: what its runs would log, and whether they would pass a limit."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from threading import Lock

import numpy as np

from daq.config.rig import RigConfig
from daq.designs.closed_loop import COMMANDS, MEASURED, ClosedLoopRun, places_of_commands, play
from daq.designs.knowledge import expected_jitter, speed_noise
from daq.errors import ConfigError
from daq.experiment import Plan
from daq.hal import CHANNELS, FloatArray, IntArray, Phase, Samples
from daq.limits import Limits
from daq.limits.base import TURN
from daq.limits.encoder import Acceleration
from daq.logs.encoder import SPEED
from daq.run.plan import check_commands
from sysid import BatchSimulator, Dataset, Feedback, ProcessModel

COMMANDED = tuple(f"cmd_voltage_{name}" for name in CHANNELS)
_STEP, _HOLD, _STEPS = 0.2, 0.05, 4  # of the commands: in parts of their ranges, s, number
_WELL = 0.8  # of the draws, whose integration is to be as exact as that
_FOLLOWED, _MINORITY = 5, 0.5  # draws that are compared, and their share that may go astray
_ASTRAY = 0.05  # of the noise, by which a model may err where it is right
# Of the samples, to which a shaft may turn round for torque and edges to tell why: at first, when
# all that is told of torques hangs on it, and once there is an earlier result.
_TURNS = 0.2, 0.4
_BETWEEN = 0.5  # of a speed's noise or of what its edges make, by which it may err in that
_ACCURACY = 1e-2  # of the plant, beside which margins are wide
_FINER = 1, 2, 4  # times the steps that commands need, where an amplifier ends


class PlantBench:
    """Runs on a computed plant within the rig's limits: a bench for ``sysid.design``.

    plant: of which commands are inputs and the rig's signals outputs; others of its inputs are
    zero. turns: wound up before each run. margin: part of each limit that is kept from it: whatever
    is commanded or measured must keep them when it is so much larger. noise: of the model's outputs
    by name; a run in which the plant does what the model does not, such as an amplifier at the end
    of its range, would lead its parameters astray, and is refused as well. timed: whether the
    rig's speed is one count over the time between edges, whose instants err; a run in which the
    shaft turns round every few samples is refused then. identified: whether the draws are those of
    an identification: then none that is compared may lead the model astray, and a shaft may turn
    round more often. strays, turning: runs
    that were refused since the plant does what the model does not, or since the shaft turns round.
    """

    def __init__(
        self,
        model: ProcessModel,
        plant: ProcessModel,
        rig: RigConfig,
        turns: float = 0.0,
        margin: float = 0.1,
        noise: Mapping[str, float] | None = None,
        timed: bool = False,
        identified: bool = False,
    ) -> None:
        for name in set(model.input_names) - {*COMMANDS, *plant.output_names}:
            raise ConfigError(
                f"model {model.name} has the input {name}, and nothing tells it: it is no command, "
                f"and the plant's outputs are {', '.join(plant.output_names)}",
                cure="name a plant that has it, with --plant",
            )
        signals = [name for name in MEASURED if name in plant.output_names]
        if not set(COMMANDS) <= set(plant.input_names) or "omega" not in signals:
            raise ConfigError(
                f"plant {plant.name} does not turn commands into a rig's signals",
                cure=f"give it the inputs {' and '.join(COMMANDS)}, and outputs among "
                f"{', '.join(MEASURED)}",
            )
        self._model, self._rig, self._turns = model, rig, turns
        self._timed = timed and SPEED in model.output_names
        self._identified, self.strays, self.turning = identified, 0, 0
        self._scale = 1.0 / (1.0 - margin)
        self._simulator = BatchSimulator(plant, accuracy=_ACCURACY, threads=1)
        self._model_simulator = BatchSimulator(model, accuracy=_ACCURACY, threads=1)
        self._noise = {n: s for n, s in (noise or {}).items() if n in model.output_names}
        starts = dict(zip(plant.state_names, plant.initial_state.tolist(), strict=True))
        named = zip(model.state_names, model.initial_state.tolist(), strict=True)
        self._starts = np.array([[starts.get(name, start) for name, start in named]])
        shared = [name for name in model.parameter_names if name in plant.parameter_names]
        self._from = [model.parameter_names.index(name) for name in shared]
        self._to = [plant.parameter_names.index(name) for name in shared]
        self._commanded = places_of_commands(plant)
        self._choosing = Lock()
        self._steps_of: dict[bytes, IntArray] = {}

    def records(
        self, inputs: FloatArray | Feedback, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """As of ``sysid.experiments.bench.Bench``; inputs: commands (n_samples, 2) [V].

        Of a feedback, commands that answer what is ``MEASURED``. Refused is what passes a limit
        with any vector, and what leads the model astray with the likeliest or with more than half
        of those that are compared, or any that is known to be plausible.
        """
        if isinstance(inputs, Feedback):
            return self._closed_loops(inputs, dt, vectors)
        return self._open_loops(inputs, dt, vectors)

    def signals(
        self, inputs: FloatArray | Feedback, dt: float, vectors: FloatArray
    ) -> dict[str, FloatArray]:
        """What would be commanded and the rig's sensors see, by name, each (n, n_samples).

        vectors: (n, n_parameters), of the model's parameters. A controller that ends its run leaves
        the commands at zero.
        """
        if isinstance(inputs, Feedback):
            each = [self._played(inputs, dt, vector) for vector in vectors]
            return {name: np.concatenate([of_it[name] for of_it in each]) for name in each[0]}
        steps, _ = self._finer(inputs, dt, vectors)
        rows = (len(vectors), len(inputs))
        commanded = {name: np.broadcast_to(inputs[:, j], rows) for j, name in enumerate(COMMANDED)}
        return {**commanded, **self._run(inputs, dt, vectors, int(steps.max()))}

    def logged(
        self, inputs: FloatArray | Feedback, dt: float, vector: FloatArray
    ) -> Dataset | None:
        """What a run would log if parameters were these, None where a limit would stop it.

        vector: (n_parameters,). ``records`` refuses more: what would lead the model astray.
        """
        if isinstance(inputs, Feedback):
            run = self._play(inputs, dt, vector)
            if run is None or not self._allowed(run, dt):
                return None
            return self._record(run.commands, dt, run.signals, 0)
        steps, _ = self._finer(inputs, dt, vector[None])
        signals = self._run(inputs, dt, vector[None], int(steps[0]))
        allowed = self._commands_allowed(inputs, dt) and self._within_limits(inputs, dt, signals)
        return self._record(inputs, dt, signals, 0) if allowed else None

    def _open_loops(
        self, inputs: FloatArray, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """As ``records``: all vectors are driven by the same commands."""
        if not self._commands_allowed(inputs, dt):
            return None
        # What refuses most is computed first.
        steps, larger = self._finer(inputs, dt, vectors)
        if not self._tells_speed(larger["omega"][0]):
            self.turning += 1
            return None
        if self._leads_astray(inputs, dt, vectors[0], larger, int(steps[0])):
            self.strays += 1
            return None
        signals: dict[str, FloatArray] = {}
        # Those that are soon computed first: they refuse most of what limits refuse.
        for k, places in enumerate(_by_steps(steps)):
            measured = self._run(inputs, dt, vectors[places], int(steps[places].max()))
            if not self._within_limits(inputs, dt, measured):
                return None
            # It refuses half of what is left, and takes less time than the slow ones.
            if k == 0 and self._lead_astray(inputs, dt, vectors, steps):
                self.strays += 1
                return None
            for name, values in measured.items():
                signals.setdefault(name, np.empty((len(vectors), len(inputs))))[places] = values
        return [self._record(inputs, dt, signals, k) for k in range(len(vectors))]

    def _closed_loops(
        self, feedback: Feedback, dt: float, vectors: FloatArray
    ) -> Sequence[Dataset] | None:
        """As ``records``: each vector has the commands that answer it."""
        records, may = [], 0 if self._identified else int(_MINORITY * _FOLLOWED)
        for k, vector in enumerate(vectors):
            run = self._play(feedback, dt, vector)
            if run is None or not self._allowed(run, dt):
                return None
            if k == 0 and not self._tells_speed(run.signals["omega"][0]):
                self.turning += 1
                return None
            if k < _FOLLOWED and self._strays(run.commands, dt, vector):
                may -= 1
                if k == 0 or may < 0:
                    self.strays += 1
                    return None
            records.append(self._record(run.commands, dt, run.signals, 0))
        return records

    def _play(self, feedback: Feedback, dt: float, vector: FloatArray) -> ClosedLoopRun | None:
        plant, count = self._simulator.model, abs(self._rig.sensors.encoder.count)
        return play(feedback, plant, self._of_plant(vector[None])[0], dt, count)

    def _allowed(self, run: ClosedLoopRun, dt: float) -> bool:
        within = self._commands_allowed(run.commands, dt)
        return within and self._within_limits(run.commands, dt, run.signals)

    def _strays(self, commands: FloatArray, dt: float, vector: FloatArray) -> bool:
        """Whether the plant does what the model does not with a vector, by its own commands."""
        steps, larger = self._finer(commands, dt, vector[None])
        return self._leads_astray(commands, dt, vector, larger, int(steps[0]))

    def _played(self, feedback: Feedback, dt: float, vector: FloatArray) -> dict[str, FloatArray]:
        """As ``signals`` of a vector, as long as the longest run; nothing where it is stopped."""
        run, commands = self._play(feedback, dt, vector), np.zeros((feedback.n_samples, 2))
        if run is not None:
            commands[: len(run.commands)] = run.commands
        return self.signals(commands, dt, vector[None])

    def _run(
        self, inputs: FloatArray, dt: float, vectors: FloatArray, n_steps: int
    ) -> dict[str, FloatArray]:
        """As ``signals``, by so many integration steps per sample."""
        values, record = self._of_plant(vectors), self._driven(inputs, dt)
        outputs = self._simulator.trajectories(values, record, n_steps)
        return self._named(outputs)

    def _named(self, outputs: FloatArray) -> dict[str, FloatArray]:
        """The plant's outputs (n, n_samples, n_outputs) by name."""
        names = self._simulator.model.output_names
        return {name: outputs[:, :, j] for j, name in enumerate(names)}

    def _of_plant(self, vectors: FloatArray) -> FloatArray:
        """The plant's parameters at vectors of the model's, one for each."""
        values: FloatArray = np.tile(self._simulator.model.nominal, (len(vectors), 1))
        values[:, self._to] = vectors[:, self._from]
        return values

    def _driven(self, inputs: FloatArray, dt: float) -> Dataset:
        """A run of the plant, of which nothing was measured."""
        plant = self._simulator.model
        driven = np.zeros((len(inputs), len(plant.inputs)))
        driven[:, self._commanded] = inputs
        return Dataset(driven, np.full((len(inputs), len(plant.outputs)), np.nan), dt)

    def _steps(self, dt: float, vectors: FloatArray) -> IntArray:
        """Integration steps per sample of each of the vectors, (n,).

        As many as it needs for steps of the commands, at most as many as most of them do: the
        runs of others are coarse, or blow up and count as beyond limits.
        """
        key = vectors.tobytes()
        with self._choosing:
            if key not in self._steps_of:
                ranges = self._rig.limits.command
                ends = np.array([ranges.motor, ranges.brake]).T
                inputs = np.repeat(
                    np.tile(_STEP * ends, (_STEPS, 1)), round(_HOLD / dt) + 1, axis=0
                )
                values, record = self._of_plant(vectors), self._driven(inputs, dt)
                steps = self._simulator.steps_of_each(values, record)
                most = int(np.quantile(steps, _WELL, method="higher"))
                self._steps_of[key] = np.minimum(steps, most)
            return self._steps_of[key]

    def _finer(
        self, inputs: FloatArray, dt: float, vectors: FloatArray
    ) -> tuple[IntArray, dict[str, FloatArray]]:
        """Steps of each of the vectors in a run, (n,): no fewer than the likeliest needs there.

        An amplifier that comes to its end needs more of them than a step of the commands. With
        them what the likeliest does at commands that are larger by the margin, as of ``signals``.
        """
        steps, likeliest = self._steps(dt, vectors), self._of_plant(vectors[:1])
        larger = self._driven(self._scale * inputs, dt)
        for finer in _FINER:
            n_steps = finer * steps[:1]
            run = self._simulator.residuals(likeliest, [larger], [None], n_steps[None], [None])
            if run.excess[0, 0] <= 1.0:
                break
        return np.maximum(steps, n_steps), self._named(np.moveaxis(run.values, 2, 0))

    def _commands_allowed(self, inputs: FloatArray, dt: float) -> bool:
        plan = Plan(len(inputs), inputs.min(axis=0), inputs.max(axis=0), inputs)
        try:
            check_commands(plan, 1.0 / dt, self._rig)
        except ConfigError:
            return False
        return True

    def _lead_astray(
        self, inputs: FloatArray, dt: float, vectors: FloatArray, steps: IntArray
    ) -> bool:
        """Whether more vectors than may, behind the first, lead the model astray.

        steps: of each, (n,).
        """
        others = np.arange(1, min(_FOLLOWED, len(vectors)))
        if not self._identified:  # of wide ranges the slow ones are soon computed
            others = 1 + np.argsort(steps[1:], kind="stable")[: _FOLLOWED - 1]
        n_steps = int(steps[others].max(initial=1))
        signals = self._run(self._scale * inputs, dt, vectors[others], n_steps)
        may, left = 0 if self._identified else int(_MINORITY * (1 + len(others))), len(others)
        while 0 <= may < left:  # else it is decided, whatever the others do
            left -= 1
            larger = {name: s[left : left + 1] for name, s in signals.items()}
            may -= self._leads_astray(inputs, dt, vectors[others[left]], larger, n_steps)
        return may < 0

    def _leads_astray(
        self,
        inputs: FloatArray,
        dt: float,
        vector: FloatArray,
        larger: Mapping[str, FloatArray],
        n_steps: int,
    ) -> bool:
        """Whether the plant does what the model does not, or what its encoder does not tell.

        Or what would pass for hardware that fails. larger: what it does at commands that are
        larger by the margin, for an amplifier ends at once; each (1, n_samples).
        """
        commands, of_it = self._scale * inputs, {name: values[0] for name, values in larger.items()}
        return not (
            self._tells_speed(of_it["omega"])
            and self._accelerates(commands, dt, of_it)
            and self._follows(self._record(commands, dt, larger, 0), vector, of_it, n_steps)
        )

    def _tells_speed(self, omega: FloatArray) -> bool:
        """Whether the encoder tells a speed (n_samples,).

        Between edges on either side of a turn there is no mean speed, and a log does not always
        show such a turn.
        """
        turns = np.mean(omega[1:] * omega[:-1] < 0.0)
        return not self._timed or bool(turns <= _TURNS[self._identified])

    def _follows(
        self,
        record: Dataset,
        vector: FloatArray,
        signals: Mapping[str, FloatArray],
        n_steps: int,
    ) -> bool:
        """Whether the model does what the plant does, to within part of the noise."""
        simulator = self._model_simulator
        # By as many steps, so that errors of the integration are alike.
        outputs = simulator.trajectories(vector[None], record, n_steps, self._starts)[0]
        most = {name: _ASTRAY * deviation for name, deviation in self._noise.items()}
        if SPEED in self._noise:
            # The torque between its samples is not known; it moves a speed, and no parameter.
            edges = speed_noise(self._rig, 1.0 / record.dt) if self._timed else 0.0
            most[SPEED] = _BETWEEN * max(self._noise[SPEED], edges)
        with np.errstate(over="ignore"):  # of a simulation that blows up
            return all(
                float(np.sqrt(np.mean((outputs[:, j] - signals[name]) ** 2))) <= most[name]
                for j, name in enumerate(simulator.model.output_names)
                if name in self._noise and name in signals
            )

    def _within_limits(
        self, inputs: FloatArray, dt: float, signals: Mapping[str, FloatArray]
    ) -> bool:
        """Whether the rig's limits let all of several runs pass, as motions of a shaft, too."""
        n_runs = len(next(iter(signals.values())))
        if not all(np.isfinite(values).all() for values in signals.values()):
            return False
        runs = [{name: values[k] for name, values in signals.items()} for k in range(n_runs)]
        return all(
            self._passes(self._samples(inputs, dt, run, self._scale))
            and self._accelerates(inputs, dt, run)
            for run in runs
        )

    def _accelerates(
        self, inputs: FloatArray, dt: float, signals: Mapping[str, FloatArray]
    ) -> bool:
        """Whether a shaft's speed changes no faster than the limit holds for possible.

        The speed alone is larger by the margin: it is compared with what currents can make of it.
        """
        limits = Limits(self._rig, only=Acceleration)
        limits.begin(Phase.RUN, 1.0 / dt)
        samples = self._samples(inputs, dt, signals, 1.0)
        return limits.check(replace(samples, omega=self._scale * samples.omega)) is None

    def _passes(self, samples: Samples) -> bool:
        limits, rate = Limits(self._rig, faults=False), 1.0 / (samples.time[1] - samples.time[0])
        if self._turns:
            limits.begin(Phase.HOMING, rate)
            limits.check(_wound(samples, self._turns))
        limits.begin(Phase.RUN, rate)
        return limits.check(samples) is None

    def _samples(
        self, inputs: FloatArray, dt: float, signals: Mapping[str, FloatArray], scale: float
    ) -> Samples:
        """A run as a log would have it, with all that it does larger by a factor."""
        n = len(inputs)
        missing = np.zeros(n)
        measured = {name: scale * signals.get(name, missing) for name in MEASURED}
        volts = {
            f"{kind}_voltage_{name}": scale * inputs[:, j]
            for j, name in enumerate(CHANNELS)
            for kind in ("cmd", "applied")
        }
        ticks: IntArray = np.arange(n, dtype=np.int64)
        time: FloatArray = ticks.astype(np.float64) * dt
        flags = np.zeros(n, dtype=np.int64)
        return Samples(tick=ticks, time=time, flags=flags, **volts, **measured)

    def _record(
        self, inputs: FloatArray, dt: float, signals: Mapping[str, FloatArray], run: int
    ) -> Dataset:
        """What the model would be given of a run."""
        commands = dict(zip(COMMANDS, inputs.T, strict=True))
        columns = [
            commands[name] if name in commands else signals[name][run]
            for name in self._model.input_names
        ]
        unseen = np.full((len(inputs), len(self._model.outputs)), np.nan)
        jitter = np.zeros_like(unseen)
        if self._timed:
            count = abs(self._rig.sensors.encoder.count)
            speeds = self._model.output_names.index(SPEED)
            jitter[:, speeds] = expected_jitter(signals[SPEED][run], dt, count)
        return Dataset(np.column_stack(columns), unseen, dt, "design", jitter=jitter)


def _wound(samples: Samples, turns: float) -> Samples:
    """Two samples of the winding that a run follows: before it, and after."""
    ends = {name: values[:2] * 0 for name, values in vars(samples).items()}
    angle = np.array([0.0, turns * TURN])
    return Samples(**{**ends, "tick": samples.tick[:2], "time": samples.time[:2], "theta": angle})


def _by_steps(steps: IntArray) -> list[IntArray]:
    """Places of the vectors that half as many steps as the most do for, and of the others."""
    few = 2 * steps <= steps.max()
    return [places for places in (np.flatnonzero(few), np.flatnonzero(~few)) if len(places)]
