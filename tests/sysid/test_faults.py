"""What is wrong with records is said before a fit; what only looks wrong is left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from sysid import Dataset, Input, Output, ProcessModel, SearchSpace, State
from sysid.judging.plausibility import implausible, start_faults
from sysid.problem.faults import after_explaining, after_mending, data_faults, mended
from tests.sysid.support import lag

DT = 0.01
N = 1000


def model(hold="zoh"):
    return lag(hold=hold)


def driven(u, noise=0.01, seed=0, tau=0.05):
    """A record of a lag of gain 2 under an input, with white noise."""
    pole = np.exp(-DT / tau)
    y = lfilter([0.0, 2.0 * (1.0 - pole)], [1.0, -pole], u)
    y += noise * np.random.default_rng(seed).standard_normal(len(u))
    return Dataset(u, y, DT, f"log {seed}")


def levels(seed=0, length=8):
    """Random levels, each held."""
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(-1.0, 1.0, N // length), length)


def wave(period=100, n=N):
    return np.sin(2.0 * np.pi * np.arange(n) / period)


TIME = DT * np.arange(N)
# Correct records whose samples look in one way or another like a fault.
CORRECT = {
    "random levels": driven(levels()),
    "binary, noise free": driven(np.sign(levels()), noise=0.0),
    "single-sample pulses": driven(np.sign(levels(length=1))),
    "square wave that settles": driven(np.sign(wave(400) + 1e-9), noise=0.0),
    "a staircase": driven(np.repeat(np.arange(10.0), 100), noise=0.0),
    "a trapezoid, again and again": driven(np.clip(3.0 * np.abs((TIME % 2) - 1) - 1, -1, 1), 0.0),
    "rest, then a step": driven((TIME > 5.0).astype(float), noise=0.0),
    "a sine": driven(wave(), noise=0.0),
    "an impulse": driven((np.arange(N) == 500).astype(float), noise=0.0, tau=0.02),
    "pulses of a sample, now and then": driven(
        (np.arange(N) % 97 == 5) * np.linspace(0.5, 1.0, N), noise=0.001, tau=0.002
    ),
    # Of four and a half samples a period at first, of a hundred at last.
    "a chirp downwards": driven(np.cos(448.0 * (1.0 - np.exp(-TIME / 3.17))), tau=0.005),
    "fine quantisation": replace(
        driven(wave()), outputs=np.round(driven(wave(), 0.0).outputs, 2)
    ),
    "one channel that moves little": driven(0.1 * levels()),
    "lost samples, few": replace(
        driven(levels()),
        outputs=np.where(
            np.isin(np.arange(N), [3, 400, 401])[:, None], np.nan, driven(levels()).outputs
        ),
    ),
    "measured every fifth row": replace(
        driven(levels()),
        outputs=np.where((np.arange(N) % 5 > 0)[:, None], np.nan, driven(levels()).outputs),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CORRECT)
def test_a_correct_record_has_no_fault(name):
    for log in (model(), model("foh")):
        faults = data_faults(log, [CORRECT[name]], [driven(levels(99), seed=99)])
        assert [fault.sentence for fault in faults if fault.severity == "doubt"] == []


def test_ramps_and_levels_of_a_command_are_meant():
    assert data_faults(model(), [CORRECT["a trapezoid, again and again"]]) == ()


def changed(record, change):
    outputs = record.outputs.copy()
    outputs[:, 0] = change(outputs[:, 0])
    return replace(record, outputs=outputs)


def one_fault(training, validation=(), inputs="zoh"):
    (fault,) = data_faults(model(inputs), training, validation)
    return fault


def rare(y):
    jolted = y.copy()
    jolted[np.random.default_rng(3).choice(N, N // 100, replace=False)] += 2.0 * y.std()
    return jolted


def hung(y):
    copy = y.copy()
    begin = 300 + int(np.argmax(np.abs(y[340:640] - y[300:600])))
    copy[begin : begin + 40] = copy[begin]
    return copy


FAULTS = {
    "clipped": lambda y: np.clip(y, -0.8 * y.max(), 0.8 * y.max()),
    "frozen": hung,
    "outliers": rare,
    "coarse": lambda y: 0.4 * np.round(y / 0.4),
}


@pytest.mark.parametrize(("averaged", "left"), [(40, 0), (5, 1)])
def test_a_mean_is_the_same_in_all_samples_that_it_is_the_mean_of(averaged, left):
    """As a speed between two edges of an encoder."""
    record = changed(driven(levels(0), seed=0), hung)
    same = np.flatnonzero(np.diff(record.outputs[:, 0]) == 0.0)
    windows = np.zeros((N, 1, 2))
    rows = np.arange(same[0], same[-1] + 2)
    windows[rows, 0, 0], windows[rows, 0, 1] = (rows[0] - rows) * DT, (rows[0] - rows) * DT
    windows[rows, 0, 1] += averaged * DT
    faults = data_faults(model(), [replace(record, windows=windows)])
    assert [fault.kind for fault in faults] == ["frozen"] * left


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("kind", FAULTS)
def test_a_faulty_channel_is_named_with_its_number_and_cure(kind, seed):
    record = changed(driven(levels(seed), seed=seed), FAULTS[kind])
    fault = one_fault([record])
    assert (fault.kind, fault.channel, fault.severity) == (kind, "y", "doubt")
    assert fault.moves_parameters and fault.records == (record.name,)
    assert "y" in fault.statement and fault.cure and fault.effect


def test_clipping_on_one_side_gives_its_level():
    record = changed(driven(wave()), lambda y: np.minimum(y, 1.5))
    fault = one_fault([record])
    assert "ends at 1.5," in fault.statement
    assert fault.share == pytest.approx(np.mean(record.outputs == 1.5))


@pytest.mark.parametrize("seed", range(5))
def test_a_few_samples_that_are_cut_off_are_seen_where_no_value_comes_again(seed):
    whole = driven(wave(), noise=0.05, seed=seed)
    assert not data_faults(model(), [whole], [])
    fault = one_fault([changed(whole, lambda y: np.minimum(y, np.sort(y, axis=0)[-4]))])
    assert (fault.kind, fault.channel, fault.share) == ("clipped", "y", 4 / N)


def test_a_measured_input_is_examined_like_an_output():
    record = driven(wave(), seed=1)
    measured = record.inputs + 0.01 * np.random.default_rng(2).standard_normal((N, 1))
    record = replace(record, inputs=np.clip(measured, -0.8, 0.8), input_noise=np.array([0.01]))
    fault = one_fault([record])
    assert (fault.kind, fault.channel, fault.severity) == ("clipped", "u", "doubt")


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.5])
def test_steps_are_coarse_where_no_noise_carries_the_channel_across_them(noise):
    """A tacho that counts 16 steps: with half a step of noise their mean errs by 1/400 of one."""
    step = 2.0 / 16
    record = driven(0.5 * np.sign(levels()), noise=noise * step, tau=0.2)
    rounded = changed(record, lambda y: step * np.round(y / step))
    kinds = [fault.kind for fault in data_faults(model(), [rounded])]
    assert kinds == (["coarse"] if noise < 0.4 else [])


def test_a_fault_of_the_validation_moves_no_parameter():
    record = driven(levels(1), seed=1)
    fault = one_fault([driven(levels())], [changed(record, FAULTS["clipped"])])
    assert (fault.kind, fault.part, fault.severity) == ("clipped", "validation", "doubt")
    assert not fault.moves_parameters and "no parameter" in fault.effect


def test_a_limited_command_is_left_to_the_user():
    fault = one_fault([driven(np.clip(wave(), -0.8, 0.8))])
    assert (fault.kind, fault.channel, fault.severity) == ("clipped", "u", "note")
    assert not fault.moves_parameters


def test_a_copy_is_no_validation_whatever_its_name():
    record = driven(levels())
    cut = record.part(200, 700, "cut")
    rounded = replace(cut, inputs=np.round(cut.inputs, 3), outputs=np.round(cut.outputs, 3))
    longer = replace(record, outputs=np.round(record.outputs, 3), name="longer")
    for copy in (replace(record, name="other"), cut, replace(rounded, name="cut, fewer digits")):
        fault = one_fault([record], [copy])
        assert fault.kind == "copy" and fault.voids_validation and not fault.moves_parameters
        assert fault.records == (copy.name,) and "log 0" in fault.statement
        assert "e+" not in fault.statement
    fault = one_fault([record.part(0, 700, "begin")], [longer])
    assert fault.kind == "copy" and fault.statement.startswith("70 %")
    # Of logs that overlap by less the rest is new, and still they are not two.
    overlapping = one_fault([record.part(0, 550, "begin")], [record.part(350, 900, "end")])
    assert overlapping.kind == "copy" and overlapping.statement.startswith("36 %")


def test_a_copy_in_training_counts_twice():
    record = driven(levels())
    fault = one_fault([driven(levels(5), seed=5), record, replace(record, name="again")])
    assert fault.kind == "copy" and fault.part == "training" and fault.records == ("again",)


def test_the_same_experiment_measured_twice_is_no_copy():
    assert data_faults(model(), [driven(levels())], [driven(levels(), seed=1)]) == ()


def test_a_validation_that_does_not_move_is_none():
    rest = driven(1e-6 * levels(1), seed=1)
    constant = replace(rest, outputs=np.full((N, 1), 0.3))
    for record in (rest, constant):
        fault = one_fault([driven(levels())], [record])
        assert fault.kind == "still" and fault.voids_validation
        assert fault.records == (record.name,)


def test_a_gentle_validation_is_one():
    assert data_faults(model(), [driven(levels())], [driven(0.2 * levels(1), seed=1)]) == ()


def two_outputs():
    return ProcessModel(
        name="pair",
        states=(State("y", "m"), State("z", "m")),
        inputs=(Input("u", "V"),),
        outputs=(Output("y", "m"), Output("z", "m")),
        parameters=lag().parameters,
        derivative=lambda x, u, p: ((p[0] * u[0] - x[0]) / p[1], x[0] - x[1]),
    )


def test_an_output_that_never_changes_is_named():
    record = driven(levels())
    record = Dataset(record.inputs, np.column_stack([record.outputs, np.zeros(N)]), DT)
    (fault,) = data_faults(two_outputs(), [record])
    assert (fault.kind, fault.channel) == ("constant", "z")


def without(record, rows):
    """A record some rows of which were lost: its inputs count as held meanwhile."""
    inputs, outputs = record.inputs.copy(), record.outputs.copy()
    outputs[rows] = np.nan
    for k in np.arange(N)[rows].tolist():
        inputs[k] = inputs[k - 1]
    return replace(record, inputs=inputs, outputs=outputs)


def test_a_long_gap_is_a_doubt_and_a_short_one_is_mentioned():
    record = driven(levels())
    for length, severity in ((50, "doubt"), (2, "note")):
        lost = slice(200, 200 + length)
        fault = one_fault([without(record, lost)])
        assert (fault.kind, fault.severity) == ("gap", severity)
        assert f"{length} samples" in fault.statement
        if severity == "doubt":
            assert "'use: 2.5 s .. 9.99 s'" in fault.cure
            other = replace(driven(levels(1), seed=1), name="2", begin=100.0)
            fault = one_fault([replace(without(record, lost), name="1"), without(other, lost)])
            settings = "use.1=2.5 s .. 9.99 s", "use.2=102.5 s .. 109.99 s"
            assert fault.settings == settings


def test_gaps_everywhere_leave_no_part_to_fit():
    record = driven(levels())
    rows = np.arange(N) % 100 < 12
    fault = one_fault([without(record, rows)])
    assert (fault.kind, fault.severity, fault.cure) == ("gap", "doubt", "record anew")
    # With the inputs measured meanwhile nothing is unknown.
    outputs = np.where(rows[:, None], np.nan, record.outputs)
    assert not data_faults(lag(), [replace(record, outputs=outputs)])


def test_a_burst_of_interference_is_named_where_no_input_has_jumped():
    record = driven(levels(length=40))
    outputs = record.outputs.copy()
    start = int(np.flatnonzero(np.diff(record.inputs[:, 0]))[3]) + 16
    outputs[start : start + 8, 0] += np.ptp(outputs) * np.array([1, -2, 2, -1, 2, -1, 1, -2])
    fault = one_fault([replace(record, outputs=outputs)])
    assert (fault.kind, fault.settings) == ("outliers", ("robust=true",))
    left_out = np.flatnonzero(np.isnan(mended(lag(), replace(record, outputs=outputs)).outputs))
    assert set(range(start, start + 8)) <= set(left_out) <= set(range(start - 1, start + 9))


def test_the_same_fault_of_several_records_is_said_once():
    records = [changed(driven(levels(k), seed=k), FAULTS["clipped"]) for k in range(4)]
    fault = one_fault(records)
    assert set(fault.records) == {record.name for record in records}
    assert "(and 3 more)" in fault.sentence
    training, *validation = records
    (both,) = data_faults(lag(), [training], validation)
    assert both.records[0] == training.name and "(and 3 more)" in both.sentence
    assert both.part == "training" and both.moves_parameters


def shaft():
    """A shaft whose angle and speed are measured."""
    return ProcessModel(
        name="shaft",
        states=(State("angle", "rad"), State("speed", "rad/s")),
        inputs=(Input("u", "V"),),
        outputs=(Output("angle", "rad"), Output("speed", "rad/s")),
        parameters=lag().parameters,
        derivative=lambda x, u, p: (x[1], (p[0] * u[0] - x[1]) / p[1]),
    )


def turning(u, angle=1.0, speed=1.0):
    """A record of a shaft, its columns multiplied by factors."""
    omega = driven(u, noise=0.0).outputs[:, 0]
    theta = DT * np.cumsum(omega) - DT * omega
    noise = 0.001 * np.random.default_rng(0).standard_normal((N, 2))
    return Dataset(u, (np.column_stack([theta, omega]) + noise) * [angle, speed], DT, "shaft")


@pytest.mark.parametrize(
    ("factors", "words"),
    [
        ({"speed": 60 / (2 * np.pi)}, "9.5"),
        ({"angle": 180 / np.pi}, "radians for degrees"),
        ({"speed": -1.0}, "turned round"),
    ],
)
def test_a_speed_in_another_unit_than_its_angle_is_named(factors, words):
    (fault,) = implausible(shaft(), SearchSpace.of(shaft()), [turning(levels(), **factors)])
    assert fault.kind == "unit" and fault.moves_parameters and words in fault.statement


def test_a_speed_that_goes_with_its_angle_has_no_fault():
    for u in (levels(), wave(), (TIME > 5.0).astype(float), 0.01 * levels(3)):
        assert implausible(shaft(), SearchSpace.of(shaft()), [turning(u)]) == ()


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_an_output_far_beyond_the_ranges_is_named(factor):
    record = driven(levels())
    record = replace(record, outputs=factor * record.outputs)
    (fault,) = implausible(model(), SearchSpace.of(model()), [record])
    assert fault.kind == "unit" and "thousand" in fault.statement


@pytest.mark.parametrize("gain", [0.15, 2.0, 25.0])
def test_a_gain_near_the_ends_of_its_range_is_no_unit(gain):
    record = driven(levels(), noise=0.001)
    record = replace(record, outputs=0.5 * gain * record.outputs)
    assert implausible(model(), SearchSpace.of(model()), [record]) == ()


def test_an_output_of_nothing_but_noise_is_no_unit():
    quiet = Dataset(np.zeros(N), 5.0 * np.random.default_rng(0).standard_normal(N), DT)
    assert implausible(model(), SearchSpace.of(model()), [quiet]) == ()


@pytest.mark.parametrize(("explained", "left"), [(2, 0), (1, 1), (0, 1)])
def test_samples_that_stand_off_in_the_model_as_well_are_no_outliers(explained, left):
    exact, places = driven(levels(), noise=0.0), [150, 450]
    jolts = np.zeros((N, 1))
    jolts[places] = 0.8
    record = replace(exact, outputs=driven(levels()).outputs + jolts)
    faults = data_faults(model(), [record])
    assert [fault.kind for fault in faults] == ["outliers"]
    jolts[places[explained:]] = 0.0
    run = exact.outputs + 0.8 * jolts
    runs = [(record, run, record.outputs - run)]
    assert len(after_explaining(faults, model(), "training", runs)) == left
    assert after_explaining(faults, model(), "validation", runs) == faults


@pytest.mark.parametrize(("expected", "left"), [(0.2, 0), (0.05, 1)])
def test_samples_that_stand_off_as_far_as_noise_of_inputs_lets_them_are_no_outliers(expected, left):
    record = driven(levels())
    jolts = np.zeros((N, 1))
    jolts[[150, 450]] = 0.8
    jolted = replace(record, outputs=record.outputs + jolts)
    faults = data_faults(model(), [jolted])
    run = driven(levels(), noise=0.0).outputs
    residual = jolted.outputs - run
    evened = residual / np.where(jolts > 0.0, expected / residual[:100].std(), 1.0)
    runs = [(jolted, run, evened)]
    assert len(after_explaining(faults, model(), "training", runs)) == left


def test_outliers_of_a_measured_input_are_named_and_mended():
    record = driven(wave(), seed=1)
    measured = record.inputs + 0.01 * np.random.default_rng(2).standard_normal((N, 1))
    measured[[100, 400, 720]] += 3.0
    record = replace(record, inputs=measured, input_noise=np.array([0.01]))
    fault = one_fault([record])
    assert (fault.kind, fault.channel) == ("outliers", "u") and "3 samples" in fault.statement
    smooth = mended(model(), record)
    assert np.abs(smooth.inputs[:, 0] - wave()).max() < 0.1
    assert data_faults(model(), [smooth]) == ()
    (note,) = after_mending([fault], model())
    assert (note.severity, note.moves_parameters) == ("note", False)


@pytest.mark.parametrize("seed", range(4))
def test_what_rare_jumps_of_an_input_do_is_no_outlier_beside_one_that_jumps_often(seed):
    """As a brake's current, that overshoots, under the levels of a motor."""
    two = replace(lag(), inputs=(Input("often", "V", "zoh"), Input("rarely", "V", "zoh")),
                  derivative=lambda x, u, p: ((p[0] * u[1] - x[0]) / p[1],))  # fmt: skip
    often, rarely = np.sign(levels(seed, length=4)), np.sign(levels(seed + 9, length=40))
    # The third sample undershoots what the first has overshot.
    y = lfilter([0.0, 1.2, -0.7, 0.6], [1.0, 0.17, 0.04], rarely)
    y += 0.03 * np.random.default_rng(seed).standard_normal(N)
    record = Dataset(np.column_stack([often, rarely]), y, DT, "ringing")
    assert data_faults(two, [record]) == ()
    jolted = y + 2.0 * (np.arange(N) == np.flatnonzero(np.diff(often))[30] + 2)
    (fault,) = data_faults(two, [replace(record, outputs=jolted[:, None])])
    assert fault.kind == "outliers" and "1 sample" in fault.statement


def test_a_short_mean_between_long_ones_is_no_outlier():
    """As of a shaft that slips: four samples repeat the mean from one slow edge to the next."""
    ends = np.cumsum(np.tile([4, 4, 4, 1], N // 13 + 1))
    place = np.searchsorted(ends, np.arange(N))
    rng = np.random.default_rng(0)
    means = 0.15 + 0.005 * rng.standard_normal(len(ends)) + 0.4 * (np.arange(len(ends)) % 32 == 3)
    record = replace(driven(levels()), outputs=means[place][:, None])
    edges = np.stack([np.append(0, ends)[place], ends[place]], axis=1) - np.arange(N)[:, None]
    averaged = replace(record, windows=DT * edges[:, None])
    assert any(fault.kind == "outliers" for fault in data_faults(model(), [record]))
    assert not any(fault.kind == "outliers" for fault in data_faults(model(), [averaged]))


def test_a_plant_that_settles_until_the_next_step_does_not_hang():
    u = np.repeat([0.0, 1.0, -1.0, 0.5], [100, 200, 300, 400]) + 0.3 * (TIME < 1.0) * wave(37)
    settled = driven(u, noise=0.0, tau=0.002)
    coarse = replace(settled, outputs=np.round(settled.outputs, 3))
    for record in (settled, coarse):
        assert not any(fault.severity == "doubt" for fault in data_faults(model(), [record]))


def starting(*ends):
    """The lag, whose start is searched in a range."""
    whole = model()
    return replace(whole, states=(replace(whole.states[0], initial_range=ends),))


def test_a_record_that_begins_where_no_start_is_searched_is_named():
    record = driven(levels(), noise=0.001)
    at_rest, moving = record.part(0, 500, "from rest"), record.part(100, 500, "later")
    first = float(moving.outputs[0, 0])
    assert abs(first) > 0.18
    (fault,) = start_faults(starting(-0.1, 0.1), [at_rest, moving])
    assert (fault.kind, fault.channel, fault.records) == ("start", "y", ("later",))
    assert f"begins at {first:.3g}" in fault.statement
    low, high = map(float, fault.settings[0].partition("=")[2].strip("[]").split(","))
    assert low < min(first, -0.09) and high > max(first, 0.09)
    assert start_faults(starting(low, high), [at_rest, moving]) == ()
    assert start_faults(starting(-0.1, 0.1), [at_rest]) == ()
    assert start_faults(model(), [moving]) == ()


def test_logs_of_other_outputs_are_no_copies():
    """Of an output that one of them does not measure nothing tells that it is the other's."""
    rng, missing = np.random.default_rng(0), np.full(400, np.nan)
    model = lag(states=(State("y", "1"), State("w", "1")),
                outputs=(Output("y", "1"), Output("w", "1")),
                derivative=lambda x, u, p: (-x[0], -x[1]))  # fmt: skip
    first, second = (rng.standard_normal((400, 2)).cumsum(axis=0) for _ in range(2))
    first[:, 1], second[:, 0] = missing, missing
    records = [Dataset(rng.standard_normal(400), y, 0.01) for y in (first, second)]
    assert "copy" not in [fault.kind for fault in data_faults(model, records, [])]
