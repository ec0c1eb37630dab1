"""The PRBS protocol against independent generators, and the shipped experiment."""

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import max_len_seq

import protocols
from daq.config.rig import RigConfig
from daq.errors import ConfigError
from daq.lookup.experiments import load_experiment
from daq.run.plan import plan
from protocols.prbs import SEQUENCE_LENGTH, Prbs, lfsr_bits
from tests.daq.support import EXPERIMENT, merged

CHANNELS = ("motor", "brake")
SHIPPED = Path(protocols.__file__).parent / "prbs.yaml"


def prbs(**changes):
    return Prbs.model_validate(merged(EXPERIMENT, changes))


def recurrence(seed, n):
    """The sequence by its recurrence over GF(2): x^16 + x^14 + x^13 + x^11 + 1.

    The first 16 bits are the seed's, lowest first; each later one is a sum of earlier ones.
    """
    bits = [(seed >> k) & 1 for k in range(16)]
    while len(bits) < n:
        bits.append((bits[-16] + bits[-14] + bits[-13] + bits[-11]) % 2)
    return np.array(bits[:n])


@pytest.mark.parametrize("seed", [1, 4, 5, 0xACE1, 20011, 31337, SEQUENCE_LENGTH])
def test_bits_are_those_of_the_recurrence(seed):
    assert np.array_equal(lfsr_bits(seed, 3000), recurrence(seed, 3000))


@pytest.mark.parametrize("seed", [1, 4, 0xACE1])
def test_bits_are_those_of_scipys_generator(seed):
    state = [(seed >> k) & 1 for k in range(16)]
    # SciPy counts taps from the other end of the register.
    expected, _ = max_len_seq(16, state=state, length=3000, taps=[5, 3, 2])
    assert np.array_equal(lfsr_bits(seed, 3000), expected)


def test_the_sequence_repeats_after_65535_bits_and_not_before():
    bits = lfsr_bits(4, 2 * SEQUENCE_LENGTH)
    first, second = bits[:SEQUENCE_LENGTH], bits[SEQUENCE_LENGTH:]
    assert np.array_equal(first, second)
    # All 65535 windows of 16 bits differ: no shorter period is possible.
    words = sum(bits[k : k + SEQUENCE_LENGTH].astype(np.int64) << k for k in range(16))
    assert len(np.unique(words)) == SEQUENCE_LENGTH and words.min() > 0
    assert first.sum() == 2**15, "one more one than zeros"
    # The autocorrelation of a maximum-length sequence is flat but for its peak.
    spectrum = np.abs(np.fft.rfft(2.0 * first - 1.0)) ** 2
    np.testing.assert_allclose(spectrum[1:], SEQUENCE_LENGTH + 1, rtol=1e-9)


@pytest.mark.parametrize("channel", [0, 1])
def test_commands_have_two_levels_around_the_offset(channel):
    settings = EXPERIMENT[CHANNELS[channel]]
    column = prbs(duration=5).waveform()[:, channel]
    expected = [
        settings["offset"] - settings["amplitude"],
        settings["offset"] + settings["amplitude"],
    ]
    np.testing.assert_allclose(np.unique(column), expected, atol=1e-15)


@pytest.mark.parametrize("rate", [200, 800, 1000, 20_000])
@pytest.mark.parametrize("channel", [0, 1])
def test_a_level_is_held_for_whole_multiples_of_the_minimum_period(rate, channel):
    experiment = prbs(sample_rate=rate, duration=3)
    column = experiment.waveform()[:, channel]
    hold = round(EXPERIMENT[CHANNELS[channel]]["minimum_period"] * rate)
    changes = np.flatnonzero(np.diff(column)) + 1
    assert len(changes) > 3 and (changes % hold == 0).all()
    assert np.gcd.reduce(changes) == hold, "no more than the minimum period either"


def test_each_sample_plays_its_bit():
    waveform = prbs(duration=1.25).waveform()
    assert waveform.shape == (1000, 2)
    motor, brake = recurrence(4, 250), recurrence(5, 25)
    np.testing.assert_allclose(waveform[:, 0], np.where(np.repeat(motor, 4), 0.85, -0.65))
    np.testing.assert_allclose(waveform[:, 1], np.where(np.repeat(brake, 40), 0.14, 0.0))


def test_channels_follow_their_own_seeds():
    one, other = prbs().waveform(), prbs(motor={"seed": 99}).waveform()
    assert np.array_equal(one[:, 1], other[:, 1])
    assert not np.array_equal(one[:, 0], other[:, 0])


@pytest.mark.parametrize(
    ("period", "near"),
    [
        (0.0051, "0.005 or 0.00625"),  # 4.08 samples at 800 Hz
        (0.0001, "0.00125"),  # less than one sample
        (1.0001, "1 or 1.00125"),
    ],
)
def test_a_period_that_is_no_whole_number_of_samples_names_the_nearest(period, near):
    with pytest.raises(ConfigError) as refused:
        plan(prbs(motor={"minimum_period": period}), RigConfig())
    assert str(refused.value).startswith("motor.minimum_period: ")
    assert str(refused.value).endswith(f"the nearest that are: {near} s")


def test_a_period_that_is_whole_but_for_rounding_is_accepted():
    assert len(prbs(sample_rate=3.0, duration=10, motor={"minimum_period": 1 / 3},
                    brake={"minimum_period": 2 / 3}).waveform()) == 30  # fmt: skip


def test_the_plan_is_refused_where_it_leaves_the_rigs_limits():
    with pytest.raises(ConfigError, match=r"brake: the plan asks for 0.4 V in sample \d+, outside"):
        plan(prbs(brake={"amplitude": 0.2, "offset": 0.2}), RigConfig())
    with pytest.raises(ConfigError, match=r"brake: the plan asks for -0.05 V in sample"):
        plan(prbs(brake={"amplitude": 0.1, "offset": 0.05}), RigConfig())
    with pytest.raises(ConfigError, match=r"motor: the plan asks for 5.1 V"):
        plan(prbs(motor={"amplitude": 5.0}), RigConfig())


def test_the_shipped_file_is_the_thesiss_experiment():
    shipped = load_experiment(str(SHIPPED)).experiment
    assert shipped.sample_rate == 800 and shipped.n_samples == 1000
    assert shipped.motor.model_dump() == {
        "amplitude": 0.75, "offset": 0.1, "minimum_period": 0.005, "seed": 4,
    }  # fmt: skip
    assert shipped.brake.model_dump() == {
        "amplitude": 0.07, "offset": 0.07, "minimum_period": 0.05, "seed": 5,
    }  # fmt: skip
    motor, brake = shipped.plan().remarks
    assert motor.startswith("motor: 250 bits, 46 % of them high")
    levels = shipped.waveform()[:, 1]
    longest = max(len(part) for part in np.split(levels, np.flatnonzero(np.diff(levels)) + 1))
    assert brake == (
        f"brake: 25 bits, 12 % of them high; at one level for {longest / 800:.3g} s at most"
    )
    assert shipped.homing.turns == 5 and shipped.calibration.samples >= 100


def test_the_shipped_validation_run_differs_in_its_seeds_alone():
    shipped = load_experiment(str(SHIPPED))
    validation = shipped.validation()
    one, other = shipped.experiment.model_dump(), validation.experiment.model_dump()
    for settings in (one, other):
        settings.pop("validation")
        seeds = [settings[name].pop("seed") for name in CHANNELS]
        settings["seeds"] = seeds
    assert one.pop("seeds") != other.pop("seeds") and one == other
    assert validation.name == "prbs-validation"
    # Sequences of one register are parts of one another: they must not overlap in the run.
    motor, check = (e.waveform()[:, 0] for e in (shipped.experiment, validation.experiment))
    assert abs(np.corrcoef(motor, check)[0, 1]) < 0.3
