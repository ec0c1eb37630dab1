"""Which structures designed experiments tell apart, beside the shipped PRBS of equal time.

python -m benchmarks.discriminate [--json] [--seeds 2] [--time 5] [--repeats 8] [--candidates 32]
    [--hysteresis bouc-wen dahl lugre] [--friction none stribeck]
    [--rig free_shaft.yaml] [--model actuator:limits=true,load=free,sensor=between]

What is known before is that hidden values are within a factor of 0.6 to 1.6 of the nominal ones.
For each pair the noncentrality of the refitted rival, and the probability that a test at 1 %
refuses it, both at the nominal values and of each run once. Then, for each seed and each structure
as the truth, hidden parameters are drawn, the runs are simulated, each ``repeats`` times, with
noise of the sensors and with what noise of a measured torque does to the right model, and every
structure is fitted to them: a pair is separated where the BIC of the rival is larger by more than
10. (A rival is not fitted by a noisy torque itself: what noise of an input does to parameters is
the identification's matter.) A truth of which a limit would stop a run is counted beside.

With the load on the shaft and its torque measured (``--rig simulated.yaml --model actuator``) the
noise of that torque hides LuGre's damping, and the cable bounds what a run may do.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks._common import arguments, report
from daq.config.yaml_file import TypedSettings
from daq.designs import discrimination
from daq.designs.setup import Setup, set_up_structures
from daq.lookup.experiments import load_experiment
from sysid import BatchSimulator, Discrimination, Excitation, ModelError, SearchSpace, discriminate
from sysid.arrays import FloatArray
from sysid.experiments import Prior, rivals
from sysid.experiments.experiment import deviations_of
from sysid.experiments.information import Informant
from sysid.experiments.rivals import FULL, Answer, Effort, Hypothesis, RivalFit, nested
from sysid.experiments.tournament import CLEAR
from sysid.threads import Workers, available_cores, one_thread

RIG, MODEL = "free_shaft.yaml", "actuator:limits=true,load=free,sensor=between"
CHECKS = 64  # of the parameters with which runs must keep the limits
RATE, RUN = 800.0, 1.25  # Hz, s
ACCURACY = 1e-2  # of rigs and fits alike, by the same steps
STRONG = 10.0  # difference of BIC
ITERATIONS = 100  # of a fit
SHARE = 0.05  # of what a rival leaves too much, by which an iteration is to lower it
# Iterations after which the second fit of a rival ends if it leaves more than the first by so much.
HEAT, HOPELESS = 10, 10.0
SPREAD = 0.6, 1.6  # of hidden values about the nominal ones


@dataclass(frozen=True)
class Excess(Effort):
    """Ends a fit to a noisy log where it gains little of what it leaves beyond the right one.

    right: the score of the right structure.
    """

    right: float

    def little(self, gain: float, left: float) -> bool:
        """Whether a gain decides nothing."""
        excess = left - self.right
        return gain < (self.share * excess if excess > CLEAR else self.most)


def main() -> None:
    parser = arguments(__doc__ or "")
    parser.add_argument("--seeds", type=int, default=2, help="hidden parameters drawn")
    parser.add_argument("--time", type=float, default=5.0, help="of all runs [s]")
    parser.add_argument("--candidates", type=int, default=32, help="runs tried at random")
    parser.add_argument("--hysteresis", nargs="+", default=["bouc-wen", "dahl", "lugre"])
    parser.add_argument("--friction", nargs="+", default=["none", "stribeck"])
    parser.add_argument("--rig", default=RIG, help="on which runs are made")
    parser.add_argument("--model", default=MODEL, help="of which structures are variants")
    parser.add_argument("--repeats", type=int, default=8, help="how often each run is made")
    options = parser.parse_args()
    structures = {"hysteresis": options.hysteresis, "friction": options.friction}
    question = {"structures": structures, "time": options.time, "run": RUN, "checks": CHECKS}
    question |= {"rig": options.rig, "model": options.model}
    question |= {"candidates": options.candidates, "generations": 3, "offspring": 8}
    report(figures(question, options.seeds, options.repeats), options.json, show)


def figures(question: Mapping[str, Any], seeds: int, repeats: int) -> dict[str, Any]:
    setups = of_question(question)
    begin = time.perf_counter()
    designed = discrimination.choose(setups)
    seconds = time.perf_counter() - begin
    shipped = load_experiment("prbs.yaml").experiment.plan().commands
    runs = {"designed": [run.inputs for run in designed.runs]}
    runs["prbs"] = [shipped[: round(RUN * RATE)]] * len(designed.runs)
    rigs = of_question({**question, "margin": 0.0})  # what stops a run is the limit itself
    judged = {"designed": designed, "prbs": of_fixed(setups, runs["prbs"])}
    return {
        "seconds": seconds,
        "attempts": designed.attempts,
        "runs": [{"protocol": run.excitation, **run.settings} for run in designed.runs],
        "predicted": {name: table(each) for name, each in judged.items()},
        "separated": {
            name: [counted(name, rigs, commands * repeats, seed) for seed in range(seeds)]
            for name, commands in runs.items()
        },
    }


def of_question(question: Mapping[str, Any]) -> dict[str, Setup]:
    """A question's structures, with what is known before."""
    return {
        name: replace(each, prior=within_spread(each.space))
        for name, each in set_up_structures(TypedSettings.of(dict(question))).items()
    }


def within_spread(space: SearchSpace) -> Prior:
    """What is known before: hidden values are the nominal ones, to within the spread."""
    values = Prior.of_ranges(space).values
    low, high = (space.encode(factor * values) for factor in SPREAD)
    return Prior(values, np.diag((high - low) ** 2 / 12.0))


def of_fixed(setups: Mapping[str, Setup], commands: Sequence[FloatArray]) -> Discrimination | None:
    """What runs that are given would tell; None where they would pass a limit."""
    first = next(iter(setups.values()))
    fixed = Excitation("fixed", {}, lambda _: commands[0], 1.0 / RATE)
    try:
        return discriminate(
            {name: each.problem.model for name, each in setups.items()},
            [fixed],
            noise=first.noise,
            runs=len(commands),
            spaces={name: each.space for name, each in setups.items()},
            priors={name: each.prior for name, each in setups.items()},
            benches={name: each.bench for name, each in setups.items()},
            checks=1,
            candidates=1,
            generations=0,
        )
    except ModelError:
        return None


def table(judged: Discrimination | None) -> list[dict[str, Any]] | None:
    if judged is None:
        return None
    return [
        {"truth": c.truth, "rival": c.rival, "distance": c.distance, "probability": c.probability}
        for c in judged.contests
    ]


def counted(
    name: str, setups: Mapping[str, Setup], commands: Sequence[FloatArray], seed: int
) -> dict[str, Any]:
    """As ``separated``, and a line of it when it is there."""
    of_seed = separated(setups, commands, seed)
    missed = [pair for pair, more in of_seed["differences"].items() if more <= STRONG]
    print(f"{name}, seed {seed}: {of_seed['separated']} of {of_seed['pairs']}, "
          f"{of_seed['beyond_limits']} beyond limits; {'; '.join(missed)}",
          file=sys.stderr, flush=True)  # fmt: skip
    return of_seed


@one_thread()
def separated(
    setups: Mapping[str, Setup], commands: Sequence[FloatArray], seed: int
) -> dict[str, Any]:
    """Pairs that fits to noisy runs of hidden rigs separate, of how many."""
    hypotheses = [hypothesis(name, each) for name, each in setups.items()]
    rng = np.random.default_rng(seed)
    tasks, beyond = [], 0
    rigs = [drawn(each.space, rng) for each in hypotheses]  # the same whatever the runs
    for i, (truth, hidden) in enumerate(zip(hypotheses, rigs, strict=True)):
        answers = noisy(truth, hidden, list(setups.values())[i], commands, rng)
        if answers is None:
            beyond += 1
            continue
        # From where a wide search would come to as well: the same brake in the rival's terms.
        tasks += [
            (i, j, answers, nested(each, *in_terms_of(each, truth.space.names, hidden)))
            for j, each in enumerate(hypotheses)
        ]
    scores: dict[tuple[int, int], float] = {}

    def fit(task: tuple[int, int, list[Answer], FloatArray]) -> None:
        i, j, answers, start = task
        rival, right = hypotheses[j], scores.get((i, i))
        left = least_left(answers, rival, start, right)
        n = sum(each.outputs.size for each in answers)
        scores[i, j] = left + len(rival.values) * float(np.log(n))

    workers = Workers(available_cores())
    workers.each(fit, [task for task in tasks if task[0] == task[1]])
    workers.each(fit, [task for task in tasks if task[0] != task[1]])
    names = [each.name for each in hypotheses]
    told = {f"{names[i]} / {names[j]}": scores[i, j] - scores[i, i] for i, j, *_ in tasks if i != j}
    return {
        "separated": sum(difference > STRONG for difference in told.values()),
        "pairs": len(told),
        "beyond_limits": beyond,
        "differences": told,
    }


def least_left(
    answers: Sequence[Answer], rival: Hypothesis, start: FloatArray, right: float | None
) -> float:
    """What a rival leaves of noisy logs, fitted from its likeliest values and another start.

    right: the score of the right structure, None where that is fitted.
    """
    effort = FULL
    if right is not None:
        effort = Excess(SHARE, FULL.most, FULL.patience, FULL.nothing, right)
    near, likeliest = (RivalFit(answers, rival, at, effort) for at in (start, rival.values))
    near.advance(ITERATIONS)
    likeliest.advance(HEAT)
    if likeliest.left - near.left < HOPELESS * max(near.left - (right or 0.0), CLEAR):
        likeliest.advance(ITERATIONS)
    return min(near.left, likeliest.left)


def in_terms_of(
    rival: Hypothesis, names: Sequence[str], hidden: FloatArray
) -> tuple[Sequence[str], FloatArray]:
    """A hidden rig's values by name, its brake as the rival's law has it.

    All three laws slide at a torque and yield at a rate: alpha z and sigma of Dahl's, of LuGre's
    alpha / zeta and zeta, of Bouc-Wen's alpha A / (gamma + beta) and gamma + beta.
    """
    values = dict(zip(names, hidden.tolist(), strict=True))
    bouc_wen = "A" in values
    rate = values["gamma"] + values["beta"] if bouc_wen else values.get("zeta", 0.0)
    rate = rate or values["sigma"]
    slides = values["A"] / rate if bouc_wen else 1.0 / values.get("zeta", 1.0)
    law = set(rival.space.names)
    beta = rival.values[rival.space.names.index("beta")] if "beta" in law else 0.0
    beta = min(values.get("beta", 0.1 * beta), 0.5 * rate)
    per = {"A": values.get("A", rate), "gamma": rate - beta, "beta": beta}
    per |= {"sigma": rate, "zeta": rate}
    size = rate if "zeta" in law else rate / per["A"] if "A" in law else 1.0
    per |= {name: values[name] * slides * size for name in ("alpha0", "alpha1")}
    values |= per
    return list(values), np.array(list(values.values()))


def noisy(
    truth: Hypothesis,
    hidden: FloatArray,
    setup: Setup,
    commands: Sequence[FloatArray],
    rng: np.random.Generator,
) -> list[Answer] | None:
    """What a rig of a structure logs; None where a run would pass a limit.

    hidden: (n_free,), its parameters.
    """
    there = replace(truth, values=hidden)
    of_inputs = np.array([setup.noise.get(name, 0.0) for name in setup.problem.model.input_names])
    answers: list[Answer] = []
    places = {id(each): each for each in commands}
    for place, count in Counter(map(id, commands)).items():
        each = places[place]
        record = setup.bench.logged(each, 1.0 / RATE, truth.space.full(hidden[None])[0])
        if record is None:
            return None
        steps = int(truth.simulator.steps_of_each(truth.space.full(hidden[None]), record)[0])
        answer, shape = rivals.answer(there, record, steps), record.inputs.shape
        vector, n_steps = truth.space.full(hidden[None]), answer.n_steps
        # Of a speed between edges, what their instants err by as well.
        deviations = np.sqrt(truth.informant.variances(record, answer.outputs[None])[0])
        errors = np.zeros(deviations.shape)
        for _ in range(count):
            errors += deviations * rng.standard_normal(deviations.shape)
            if not of_inputs.any():
                continue
            noisy = replace(record, inputs=record.inputs + of_inputs * rng.standard_normal(shape))
            errors -= truth.simulator.trajectories(vector, noisy, n_steps)[0] - answer.outputs
        # Of runs that are alike their mean tells all: what each differs from it by no model moves.
        answers += [replace(answer, outputs=answer.outputs + errors / count)] * count
    return answers


def drawn(space: SearchSpace, rng: np.random.Generator) -> FloatArray:
    """Hidden values about the nominal ones that keep the model's constraints."""
    nominal = np.array([parameter.nominal for parameter in space.parameters])
    while True:
        hidden = np.clip(nominal * rng.uniform(*SPREAD, len(nominal)), space.lower, space.upper)
        if space.feasible(hidden):
            return np.asarray(hidden, dtype=np.float64)


def hypothesis(name: str, setup: Setup) -> Hypothesis:
    model, space, prior = setup.problem.model, setup.space, setup.prior
    simulator = BatchSimulator(model, accuracy=ACCURACY, threads=1)
    informant = Informant(simulator, space, *deviations_of(model, setup.noise))
    return Hypothesis(name, simulator, informant, space, prior.values, prior.information())


def counts(seeds: Sequence[Mapping[str, Any]]) -> dict[str, tuple[int, int]]:
    """How often each ordered pair was separated, and of how many rigs."""
    differences: dict[str, list[float]] = {}
    for each in seeds:
        for pair, difference in each["differences"].items():
            differences.setdefault(pair, []).append(difference)
    return {
        pair: (sum(d > STRONG for d in values), len(values)) for pair, values in differences.items()
    }


def show(figures: dict[str, Any]) -> None:
    print(f"\n{figures['seconds']:.0f} s, {figures['attempts']} runs simulated")
    for name, rows in figures["predicted"].items():
        print(f"\n{name}: chi-square distance, probability of refusal")
        for row in rows or ():
            print(f"  {row['truth']:38} {row['rival']:38} {row['distance']:10.4g} "
                  f"{100 * row['probability']:6.1f} %")  # fmt: skip
    for name, seeds in figures["separated"].items():
        shares = [f"{each['separated']} of {each['pairs']}" for each in seeds]
        print(f"\n{name}: separated {', '.join(shares)}; beyond limits "
              f"{[each['beyond_limits'] for each in seeds]}")  # fmt: skip
        for pair, (separate, rigs) in counts(seeds).items():
            if separate < rigs:
                print(f"  {pair}: {separate} of {rigs}")


if __name__ == "__main__":
    main()
