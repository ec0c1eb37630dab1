"""Source text of the kernel that runs an extended Kalman filter over a record.

The states x, the noise n on inputs, that of the process w and the outputs' v, white and
independent:

    x_(k+1) = F(x_k, u_k + n_k, u_(k+1) + n_(k+1)) + w_k        y_k = g(x_k, u_k + n_k) + v_k

w_k is the response to noise of given intensities in the states' rates. F is the simulated step of
the batch kernel, its Jacobian Phi that of the same step (see ``variation``). Of the estimate of x_k
and n_k from all samples before, with covariance P, the outputs of a sample are taken in one after
the other (Anderson & Moore, "Optimal filtering", section 6.4): with the row C of g's Jacobian and
the variance r of the output

    e = y - g      s = C P C' + r      (x, n) += P C' e / s      P -= P C' C P / s

and what is kept of e, the innovation, is e sqrt(r0 / s), with r0 a variance like r but the same for
all samples: without noise of inputs and process, and of one variance, the error of the free run.
Noise of the inputs may be coloured: n_(k+1) is then a part of n_k, the colour, and what is new in
it. So is how late means were, t_k, of variance one, of which an output has its shift times t_k
more. With noise of the process the sum of log(s / r) stands behind the sum of their squares. With
``corrects`` zero nothing is taken in: e is that error whatever the noise, and s its variance.
Chromosomes are lanes, as in the batch kernel; ``halves`` of them, one or two, are worked out.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

from sysid.engine.batch_kernel import EACH_LANE, BatchKernel, at, residuals_kept
from sysid.engine.program import block
from sysid.engine.scheme import LANES, STEP_SIZES
from sysid.engine.variation import Cause, Variation
from sysid.problem.model import ProcessModel

_Place = tuple[int, int]
_ROOT_3 = repr(3.0**0.5)
_WEIGHTS = ("before", "now", "between", "so_far")
_OF_MEAN, _OF_SUM = 0, 1
_HALF = LANES // 2


class FilterKernel(BatchKernel):
    """Text of the filter; needs what the batch kernel needs, and the program of a variation.

    averaged: outputs that are measured as means over a time that ends with the sample. The model
    then has the integrals of these, in their order, as its last states and its last outputs: they
    begin at zero in every sample. A mean is the output at the sample before, that at the sample,
    the integral in between and the sum so far, times the ``mean`` weights; so is, by weights of its
    own, the sum that is kept for the next sample. jittered: how late these means were is a state.

    Behind the rows of lanes of the batch kernel the work area holds P's upper triangle, of the
    reached states, then of the noisy inputs, then of the averaged outputs at the sample before, of
    their sums so far and of how late they were, the estimates of each noise and of all those, and
    measured outputs, then their innovations. Loops over lanes that work out more than a few numbers
    read and write nothing else: LLVM would have to make sure that no array overlaps another, and
    leaves what needs many such checks as scalar code.
    """

    def __init__(
        self,
        model: ProcessModel,
        variation: Variation,
        averaged: Sequence[int] = (),
        *,
        coloured: bool = False,
        jittered: bool = False,
    ) -> None:
        super().__init__(model, variation.structure)
        self.coloured = coloured
        self.variation, self.reached = variation, variation.reached
        self.n_noises = len(variation.noisy)
        self.counts["gains"] = len(variation.gains)
        self.size = len(self.reached) + self.n_noises
        self.n_measured = self.n_outputs - len(averaged)
        # Of one that no noise reaches the free run tells all.
        first = variation.n_states - len(averaged)
        integral = {j: first + m for m, j in enumerate(averaged) if self._gains(j)}
        self.averaged = list(integral)
        self.integral = {j: self.reached.index(i) for j, i in integral.items()}
        self.lag = {j: self.size + m for m, j in enumerate(self.averaged)}
        count = len(self.averaged)
        self.summed = {j: place + count for j, place in self.lag.items()}
        self.late = {j: place + count for j, place in self.summed.items() if jittered}
        self.places = range(self.size + 2 * count + len(self.late))
        self.pairs = [(a, b) for a in self.places for b in self.places if a <= b]
        self.covariance = self.work_rows
        self.noises = self.covariance + len(self.pairs)
        self.before = self.noises + self.n_noises - self.size
        self.innovation = self.before + len(self.places)
        self.work_rows = self.innovation + self.n_measured

    def text(self, *, many_registers: bool = False) -> str:
        """Python text of ``innovations``."""
        q, outputs = self.n_measured, range(self.n_measured)
        sample = [
            *[f"v{j} = u[k, {j}]" for j in range(self.n_recorded)],
            *[f"v{j} = 0.0" for j in range(self.n_recorded, self.n_inputs)],
            *[f"w{j} = w[k, {j}]" for j in outputs],
            *[f"seen{j} = 1.0 if w{j} > 0.0 else 0.0" for j in outputs],
            *[f"of_output{j} = r[k, {j}]" for j in outputs],
            *[f"shift{j} = shift[k, {j}]" for j in self.late],
            *self._weights_of_means(),
            *self._traced("before"),
            *[f"copy_row(X, {self.innovation + j}, y, k * {q} + {j})" for j in outputs],
            *self._each_lane(self._corrected()),
            *residuals_kept(q, self.innovation),
            *self._traced("after"),
            *block("if k == n_samples - 1:", ["break"]),
            *[f"lasting{j} = lasting[k + 1, {j}]" for j in self.late],
            *self._input_slopes(),
            *self._each_lane(self._undisturbed()),
            *block("for step in range(n_steps):", self._stage_inputs(), self._all_lanes(False)),
            *self._each_lane(self._predicted()),
        ]
        sums = f"sums[j, l] = X[({self._sums} + j) * {LANES} + l]"
        body = [
            "wide_vectors()",
            "n_samples = u.shape[0]",
            "h = dt / n_steps",
            *STEP_SIZES,
            *[f"unit{j} = unit[{j}]" for j in outputs],
            *[f"of_input{k} = s[{k}]" for k in range(self.n_noises)],
            *[f"colour{k} = colour[{k}]" for k in range(self.n_noises) if self.coloured],
            *[f"intensity{k} = intensity[{k}]" for k in range(len(self.variation.driven))],
            *self._begin(),
            *block(EACH_LANE, self._uncertain_start()),
            *block("for k in range(n_samples):", sample),
            *block(f"for j in range({2 * q}):", block(EACH_LANE, [sums])),
        ]
        head = (
            "def innovations(X, rows, tables, u, y, w, r, unit, mean, shift, lasting, s, colour, "
            "intensity, spread, corrects, start, p, dt, n_steps, halves, sums, record, before, "
            "after):"
        )
        return "\n".join(block(head, body))

    def _each_lane(self, *parts: Sequence[str]) -> list[str]:
        """Of half of the lanes, or all: many fits ask for the innovations of one chromosome."""
        lanes = f"for l in range({_HALF} * half, {_HALF} * half + {_HALF}):"
        return block("for half in range(halves):", block(lanes, *parts))

    def _traced(self, table: str) -> list[str]:
        """Keep the first lane's work area, before a sample's outputs or after them."""
        rows = block(f"for i in range({table}.shape[1]):", [f"{table}[k, i] = X[i * {LANES}]"])
        return block(f"if k < {table}.shape[0]:", rows)

    def _input_slopes(self) -> list[str]:
        rising = (f"i{j} = 1.0 / n_steps" for j in range(self.n_recorded, self.n_inputs))
        return [*super()._input_slopes(), *rising]

    def _uncertain_start(self) -> list[str]:
        """P before the first sample: ``spread`` of the states, and the noises' variances."""
        n = len(self.reached)
        variances = {
            (a, a): f"spread[{a}]" if a < n else f"of_input{a - n}" for a in range(self.size)
        }
        variances |= {(place, place): "1.0" for place in self.late.values()}
        behind = self.places[n:]
        nothing = [f"{at(self.before + place)} = 0.0" for place in behind]
        return [*self._stored(variances), *nothing]

    def _corrected(self) -> list[str]:
        """The outputs of a sample taken in, and their innovations kept."""
        n, lines = len(self.reached), self._outputs()
        if self.output_states is None and self.variation.gains:
            lines += self.call("gains", "g", [at(i) for i in range(self.n_states)], "v")
        expected = {n + k: at(self.noises + k) for k in range(self.n_noises) if self.coloured}
        expected |= {place: at(self.before + place) for place in self.late.values()}
        lines += [*self._loaded(), *[f"d{a} = {expected.get(a, 0.0)}" for a in self.places]]
        for j in range(self.n_measured):
            lines += self._taken_in(j)
        begun, kept = self.integral.values(), self._kept_of_outputs()
        for place, (terms, row) in kept.items():
            lines.append(f"next{place} = {_sum([*terms, *_products(row, 'd{}'.format)])}")
            for a in self.places:
                lines.append(f"L{place}_{a} = {_sum(_products(row, _covariance_with(a)))}")
        lines += [f"{at(self.before + place)} = next{place}" for place in kept]
        lines += [f"{at(self.before + place)} = d{place}" for place in self.late.values()]
        lines += [
            f"{at(i)} = 0.0" if a in begun else f"{at(i)} += d{a}"
            for a, i in enumerate(self.reached)
        ]
        lines += [f"{at(self.noises + k)} = d{n + k}" for k in range(self.n_noises)]
        variances = {(a, b): f"P{a}_{b}" for a, b in self.pairs}
        for place in kept:
            variances |= {(a, place): f"L{place}_{a}" for a in range(self.size)}
            variances |= {(place, late): f"L{place}_{late}" for late in self.late.values()}
            for behind, (_, row) in kept.items():
                if behind >= place:
                    variances[place, behind] = _sum(_products(row, f"L{place}_{{}}".format))
        variances = {pair: v for pair, v in variances.items() if not set(pair) & set(begun)}
        return lines + self._stored(variances)

    def _kept_of_outputs(self) -> dict[int, tuple[list[str], dict[int, str]]]:
        """What the next sample needs of averaged outputs: terms and the row by places in P."""
        kept = {place: ([f"o{j}"], self._gains(j)) for j, place in self.lag.items()}
        for j, place in self.summed.items():
            kept[place] = self._summed_up(j, _OF_SUM)
        return kept

    def _summed_up(self, j: int, of: int) -> tuple[list[str], dict[int, str]]:
        """Terms of averaged output j's mean or sum, and the row by places in P."""
        lag, integral, summed = self.lag[j], self.integral[j], self.summed[j]
        before, now, between, so_far = (f"{name}{of}_{j}" for name in _WEIGHTS)
        row = {b: f"{now} * {c}" if c else now for b, c in self._gains(j).items()}
        row |= {lag: before, integral: between, summed: so_far}
        terms = [
            f"{before} * {at(self.before + lag)}",
            f"{now} * o{j}",
            f"{between} * {at(self.reached[integral])}",
            f"{so_far} * {at(self.before + summed)}",
        ]
        return terms, row

    def _weights_of_means(self) -> list[str]:
        return [
            f"{name}{of}_{j} = mean[k, {j}, {of}, {i}]"
            for j in self.lag
            for of in (_OF_MEAN, _OF_SUM)
            for i, name in enumerate(_WEIGHTS)
        ]

    def _innovation(self, j: int) -> str:
        """Where output j is as measured, and then its innovation."""
        return at(self.innovation + j)

    def _taken_in(self, j: int) -> list[str]:
        """Output j taken in; the deviation d is what the sample's outputs have changed so far."""
        gains, size, lines = self._gains(j), self.places, []
        predicted = [f"o{j}"]
        if j in self.lag:
            predicted, gains = self._summed_up(j, _OF_MEAN)
            gains |= {self.late[j]: f"shift{j}"} if j in self.late else {}
        expected = _sum([*predicted, *_products(gains, "d{}".format)])
        lines.append(f"e = {expected} - {self._innovation(j)}")
        kept = f"e = e * (w{j} * math.sqrt(unit{j} / of_output{j}))"
        if gains:
            lines += [f"shared{a} = {_sum(_products(gains, _covariance_with(a)))}" for a in size]
            lines += [
                f"variance = {_sum(_products(gains, 'shared{}'.format))} + of_output{j}",
                f"gain = seen{j} * corrects / variance",
            ]
            lines += [f"d{a} -= shared{a} * (gain * e)" for a in size]
            lines += [f"P{a}_{b} -= shared{a} * (gain * shared{b})" for a, b in self.pairs]
            kept = f"e = e * (w{j} * math.sqrt(unit{j} / variance))"
            if self.variation.driven:
                logarithm = f"seen{j} * math.log(variance / unit{j})"
                lines.append(f"{at(self._sums + self.n_measured + j)} += {logarithm}")
        return [*lines, kept, f"{at(self._sums + j)} += e * e", f"{self._innovation(j)} = e"]

    def _estimate(self) -> list[str]:
        return []  # where they would stand are the sums of logarithms

    def _gains(self, j: int) -> dict[int, str]:
        """Row j of the outputs' Jacobian, by places in P; empty text stands for 1."""
        row: dict[int, str] = {}
        for place, (output, k) in enumerate(self.variation.gains):
            if output == j:
                row[self._place_of(k)] = "" if self.output_states is not None else f"g{place}"
        return row

    def _place_of(self, k: int) -> int:
        """Place in P of a state, or behind the model's states of a noisy input."""
        behind = k - self.variation.n_states
        return self.reached.index(k) if behind < 0 else len(self.reached) + behind

    def _undisturbed(self) -> list[str]:
        """Deviations at the start of an interval: each state's column is its own."""
        return [
            f"{at(place)} = {1.0 if cause == ('state', state) else 0.0}"
            for cause, column in self.variation.columns.items()
            for state, place in column.items()
        ]

    def _predicted(self) -> list[str]:
        """x and P of the next sample."""
        n = len(self.reached)
        phi, gamma = self._jacobian_of("state", "begin"), self._jacobian_of("end")
        fresh = {k: f"of_input{k}" for k in range(self.n_noises)}
        if self.coloured:  # what goes on of a noise acts at the interval's end as well
            fresh = {k: f"(1.0 - colour{k} * colour{k}) * {s}" for k, s in fresh.items()}
            for (a, k), response in gamma.items():
                begun = f"{phi[a, n + k]} + " if (a, n + k) in phi else ""
                phi[a, n + k] = f"({begun}colour{k} * {response})"
        lines = [*self._loaded(), *self._tilted()]
        process = self._process()
        for a, i in enumerate(self.reached):
            by_noise = {k: phi[a, n + k] for k in range(self.n_noises) if (a, n + k) in phi}
            moves = [f"{text} * {at(self.noises + k)}" for k, text in by_noise.items()]
            lines += [f"{at(i)} += {_sum(moves)}"] if moves else []
        for a in range(n):
            row = {c: phi[a, c] for c in range(self.size) if (a, c) in phi}
            for b in range(self.size):
                lines.append(f"M{a}_{b} = {_sum(_products(row, _covariance_with(b)))}")
        variances: dict[_Place, str] = {}
        for a in range(n):
            for b in range(a, n):
                terms = [f"M{a}_{c} * {phi[b, c]}" for c in range(self.size) if (b, c) in phi]
                terms += [
                    f"{gamma[a, k]} * {gamma[b, k]} * {fresh[k]}"
                    for k in range(self.n_noises)
                    if (a, k) in gamma and (b, k) in gamma
                ]
                terms += [
                    f"intensity{k} * ({level[a]} * {level[b]} + T{k}_{a} * T{k}_{b})"
                    for k, level in enumerate(process)
                    if a in level and b in level
                ]
                variances[a, b] = _sum(terms)
            for k in range(self.n_noises):
                terms = [f"{gamma[a, k]} * {fresh[k]}"] if (a, k) in gamma else []
                terms += [f"colour{k} * M{a}_{n + k}"] if self.coloured else []
                variances[a, n + k] = _sum(terms)
            for place in self.places[self.size :]:
                terms = [f"{phi[a, c]} * P{c}_{place}" for c in range(self.size) if (a, c) in phi]
                variances[a, place] = _sum(terms)
        variances |= {(n + k, n + k): noise for k, noise in fresh.items()}
        variances |= {(a, b): f"P{a}_{b}" for a, b in self.pairs if a >= self.size}
        if self.coloured:
            variances |= self._going_on(fresh)
            lines += [f"{at(self.noises + k)} *= colour{k}" for k in fresh]
        return lines + self._stored(variances | self._lasting(variances)) + self._moved_on()

    def _going_on(self, fresh: Mapping[int, str]) -> dict[_Place, str]:
        """Covariances of noises of the next sample with one another and with what is kept."""
        n, going = len(self.reached), {}
        for a, b in self.pairs:
            if n <= a < self.size:
                parts = [f"colour{a - n}", f"P{a}_{b}"]
                parts += [f"colour{b - n}"] if b < self.size else []
                going[a, b] = _sum([" * ".join(parts), *([fresh[a - n]] if a == b else [])])
        return going

    def _lasting(self, variances: Mapping[_Place, str]) -> dict[_Place, str]:
        """Covariances with how late means were, as that goes on to the next sample."""
        going = {}
        places = {place: j for j, place in self.late.items()}
        for (a, b), text in variances.items():
            parts = [f"lasting{places[place]}" for place in (a, b) if place in places]
            if parts:
                going[a, b] = " * ".join([*parts, f"({text})"])
                going[a, b] += f" + 1.0 - {' * '.join(parts)}" if a == b else ""
        return going

    def _moved_on(self) -> list[str]:
        """How late means were, as that goes on to the next sample."""
        return [f"{at(self.before + place)} *= lasting{j}" for j, place in self.late.items()]

    def _process(self) -> list[dict[int, str]]:
        """Responses to a level rate of each driven state, by row."""
        return [self._column(("level", i)) for i in self.variation.driven]

    def _tilted(self) -> list[str]:
        """Responses to sqrt(3) (2 r - 1) in the rates, with r from 0 to 1 along the interval."""
        lines = []
        for k, i in enumerate(self.variation.driven):
            level, slope = self._column(("level", i)), self._column(("slope", i))
            lines += [f"T{k}_{a} = {_ROOT_3} * (2.0 * {slope[a]} - {level[a]})" for a in level]
        return lines

    def _column(self, cause: Cause) -> dict[int, str]:
        """Deviations at the end of an interval by a cause, by row."""
        column = self.variation.columns[cause]
        return {self.reached.index(state): at(place) for state, place in column.items()}

    def _jacobian_of(self, *kinds: str) -> dict[_Place, str]:
        """Deviations at the end of an interval by row and cause, those not always zero.

        Causes at the interval's start stand as in P; those at its end are the noises alone.
        """
        entries: dict[_Place, str] = {}
        for (kind, k), column in self.variation.columns.items():
            if kind in kinds:
                behind = len(self.reached) + k if kind == "begin" else k
                b = self.reached.index(k) if kind == "state" else behind
                for state, place in column.items():
                    entries[self.reached.index(state), b] = at(place)
        return entries

    def _loaded(self) -> list[str]:
        return [f"P{a}_{b} = {self._at_pair(a, b)}" for a, b in self.pairs]

    def _stored(self, variances: Mapping[_Place, str]) -> list[str]:
        """P's upper triangle set, to zero where nothing is given."""
        return [f"{self._at_pair(*pair)} = {variances.get(pair, '0.0')}" for pair in self.pairs]

    def _at_pair(self, a: int, b: int) -> str:
        return at(self.covariance + self.pairs.index((a, b)))


def _covariance_with(a: int) -> Callable[[int], str]:
    """Entries of row a of P, which is symmetric."""
    return lambda b: f"P{min(a, b)}_{max(a, b)}"


def _products(factors: Mapping[int, str], vector: Callable[[int], str]) -> list[str]:
    """Products of factors, empty for 1, and the entries of a vector at their places."""
    return [f"{c} * {vector(b)}" if c else vector(b) for b, c in factors.items()]


def _sum(terms: Iterable[str]) -> str:
    return " + ".join(terms) or "0.0"
