"""Which walls are passive: against the closed form, against hands that would make them unstable."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from daq.experiment import Sample
from daq.lookup.controllers import load_controller
from haptics import laws
from haptics.dynamics import ActuatorDynamics
from haptics.evidence import HAND_RANGE
from haptics.feedforward import Feedforward
from haptics.linear_loop import LinearLaw, loop_margins, sampled_actuator
from haptics.operating_points import operating_point
from haptics.passivity import Hands, Passivity, Port, Tracker, UnknownPassivityError, discs
from haptics.program import HAND
from protocols.control.loop import tracker_gains
from tests.haptics.test_torque_tracking import controller

HELD = HAND[1] / HAND_RANGE  # N*m*s/rad
COUNT = 2.0 * np.pi / 8192.0
T = 1.0 / 800.0
TRACKER = Tracker(*tracker_gains(150.0, T))


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("damping", [0.0, 1e-4])
def test_of_an_ideal_amplifier_the_disc_is_the_theorem(delay, damping):
    """b > T / 2 / (1 - cos) Re((1 - e^-j) H), Colgate and Schenkel, within a thousandth."""
    b, angle = 2e-4, np.pi * np.geomspace(1e-3, 1.0, 200)
    z = np.exp(1j * angle)
    s = 1j * (angle[:, None] / T + 2.0 * np.pi / T * np.arange(-400, 401))
    nothing = np.full(s.shape, -np.inf)
    centre, radius = discs(np.ones_like(s), np.full(s.shape, b), nothing, s, T, delay)
    port = Port(centre, radius, b, 0.0)

    def needed(K):
        H = (K + damping * (z - 1.0) / z / T) / z**delay
        return (0.5 * T / (1.0 - np.cos(angle)) * ((1.0 - 1.0 / z) * H).real).max()

    stiffest = max(K for K in np.linspace(1e-3, 0.6, 600) if needed(K) < b)
    for scale, passive in ((0.99, True), (1.01, False)):
        assert port.passive(scale * stiffest + damping * (z - 1.0) / z / T) == passive


def passivity(folder, kind, draws=0, held=0.0, stiffest=np.inf, **settings):
    path = controller(folder, kind, **{"allocation": "motor", **settings})
    tuned = load_controller(str(path), folder)
    factors = np.random.default_rng(0).normal(1.0, 0.05, (draws, len(tuned.parameters)))
    actuators = np.concatenate([tuned.parameters[None], tuned.parameters * factors])
    return Passivity(tuned, TRACKER, actuators, Hands(held, stiffest))


def spectral_radius(dynamics, K, B, spring, damping=0.0):
    """Of the loop of a static law's wall, the sliding shaft and a spring at the handle."""
    Phi, Gamma, C = sampled_actuator(dynamics, "sliding forwards", (spring, damping), T)
    n, gain = len(Phi), 1.0 / (dynamics.motor_constant * dynamics.motor.gain)
    alpha, beta = TRACKER.alpha, TRACKER.beta
    A = np.zeros((n + 3, n + 3))
    A[:n, :n], A[:n, n + 2] = Phi, Gamma[:, 0]
    predicted = np.array([1.0, T])
    A[n, n : n + 2], A[n, :n] = (1.0 - alpha) * predicted, alpha * C[0]
    A[n + 1, n : n + 2] = np.array([0.0, 1.0]) - beta / T * predicted
    A[n + 1, :n] = beta / T * C[0]
    A[n + 2] = -gain * B * A[n + 1]
    A[n + 2, :n] -= gain * K * C[0]
    return np.abs(np.linalg.eigvals(A)).max()


def test_no_spring_at_the_handle_makes_a_promised_wall_unstable(tmp_path):
    check = passivity(tmp_path, "static")
    promise, dynamics = check.promise(COUNT), ActuatorDynamics(check.controller.model)
    springs = np.geomspace(1e-4, 100.0, 120)

    def worst(K):
        return max(spectral_radius(dynamics, K, promise.damping, spring) for spring in springs)

    assert worst(promise.stiffness) < 1.0
    assert worst(1.2 * promise.stiffness) > 1.0


def test_a_promise_holds_for_most_of_the_actuators(tmp_path):
    check = passivity(tmp_path, "static", draws=30)
    promise = check.promise(COUNT)
    nominal = promise.draws[0]
    assert promise.stiffness < nominal
    assert np.mean(promise.draws >= promise.stiffness) > 0.9
    assert promise.abbott <= promise.colgate


def test_what_is_taken_off_cannot_be_promised(tmp_path):
    for check in (
        passivity(tmp_path, "feedforward", held=HELD),
        # Taken off within the yield travel and not beyond: a law for each, and none for both.
        passivity(tmp_path, "feedforward", held=HELD, inertia_share=0.0),
    ):
        assert check.springs_promised() == 0.0
    assert passivity(tmp_path, "feedforward").promise(COUNT).stiffness == 0.0
    plain = {"friction_share": 0.0, "inertia_share": 0.0}
    inverse = passivity(tmp_path, "feedforward", **plain).promise(COUNT)
    assert 0.1 < inverse.stiffness < 0.2


@pytest.mark.parametrize("held", [0.0, HELD])
def test_a_promised_spring_is_nearly_the_stiffest_stable_one(tmp_path, held):
    check = passivity(tmp_path, "static", held=held)
    promised, dynamics = check.springs_promised(), ActuatorDynamics(check.controller.model)
    springs = np.geomspace(1e-4, 100.0, 120)

    def worst(K):
        return max(spectral_radius(dynamics, K, 0.0, spring, held) for spring in springs)

    assert worst(promised) < 1.0
    assert worst(1.05 * promised) > 1.0


def bounced(dynamics, K, spring, damping, lean, speed):
    """Speeds, (n, m) [rad/s], of m sliding shafts thrown at a wall at 0 rad of a static law.

    spring, damping: of the hands, (m,); lean: angles at which they rest without the wall, (m,).
    """
    parts = [
        sampled_actuator(dynamics, "sliding forwards", hand, T)
        for hand in zip(spring.tolist(), damping.tolist(), strict=True)
    ]
    Phi, Gamma, C = (np.stack(each) for each in zip(*parts, strict=True))
    theta, omega = C[0, 0].argmax(), C[0, 1].argmax()
    x = np.zeros((len(spring), Phi.shape[1]))
    x[:, theta], x[:, omega] = -lean, speed  # from where the hand rests
    gain, volts, speeds = dynamics.motor_constant * dynamics.motor.gain, np.zeros(len(spring)), []
    for _ in range(3000):
        depth = np.maximum(x[:, theta] + lean, 0.0)
        x = np.einsum("mij,mj->mi", Phi, x) + Gamma[:, :, 0] * volts[:, None]
        volts = np.clip(-K * depth / gain, -4.0, 4.0)
        speeds.append(x[:, omega])
    return np.array(speeds)


@pytest.mark.parametrize("stiffest", [np.inf, 40.0, 0.5])
def test_every_hand_is_in_every_disc(tmp_path, stiffest):
    check = passivity(tmp_path, "static", held=HELD, stiffest=stiffest)
    port, law, rng = check.ports[0], check.law, np.random.default_rng(1)
    dynamics, n = ActuatorDynamics(check.controller.model), 400
    s = 1j * (np.angle(law.z)[:, None] / T + 2.0 * np.pi / T * np.arange(-n, n + 1))
    by_volts, by_speed = actuator_currents(dynamics, s)
    hold = (1.0 - np.exp(-s * T)) / s * np.exp(-s * T) / s / T  # a sample late
    for _ in range(50):
        damping = HELD * (1.0 + rng.exponential(3.0) * rng.integers(2))
        spring = min(stiffest, 1e3) * rng.choice([0.0, 1.0, rng.uniform()])
        mass = rng.choice([0.0, 1e-5, 1e-3]) * rng.uniform()
        hand = damping + spring / s + mass * s
        shaft = dynamics.inertia * s + port.damping - dynamics.motor_constant * by_speed + hand
        angle = (dynamics.motor_constant * by_volts * hold / shaft).sum(axis=1)
        beyond = np.abs(angle - port.centre) - port.radius
        assert (beyond < 1e-3 * np.abs(angle)).all()


def actuator_currents(dynamics, s):
    """Motor current by command and by speed, from the sums of the electrical states."""
    names, inputs = dynamics.model.state_names, dynamics.model.input_names
    A, B, _, _ = dynamics.linear(0.0, 0.0, 0.0)
    inner = [k for k, name in enumerate(names) if name not in ("omega", "z", "theta")]
    poles, vectors = np.linalg.eig(A[np.ix_(inner, inner)])
    row = vectors[inner.index(names.index("current_motor"))]
    columns = B[inner, inputs.index("applied_voltage_motor")], A[inner, names.index("omega")]
    weights = [row * np.linalg.solve(vectors, column) for column in columns]
    return [sum(w / (s - p) for w, p in zip(weight, poles, strict=True)) for weight in weights]


def test_hands_that_are_no_clamps_let_the_inverse_hold_stiffer_walls(tmp_path):
    plain = {"friction_share": 0.0, "inertia_share": 0.0}
    checks = [
        passivity(tmp_path, "feedforward", held=HELD, stiffest=stiffest, **plain)
        for stiffest in (np.inf, 40.0, 4.0)
    ]
    clamps, promised, soft = (check.springs_promised() for check in checks)
    assert clamps < 0.75 * promised and promised < soft
    tuned, dynamics = checks[1].controller, ActuatorDynamics(checks[1].controller.model)
    law = LinearLaw.of(tuned.control.program(tuned.model, tuned.parameters), tuned.model)

    def stable(K):
        wall = replace(law, G=law.G.copy(), D=law.D.copy())
        wall.G[:, 0] -= K * law.G[:, 4]
        wall.D[:, 0] -= K * law.D[:, 4]
        return all(
            loop_margins(wall, dynamics, "sliding forwards", (spring, HELD), T, 1).stable
            for spring in np.geomspace(0.04, 40.0, 25)
        )

    assert stable(promised) and not stable(1.1 * promised)


def ringing(check, K, mass, spring):
    """Spectral radius of a wall's loop, the hand a damper beside a mass behind a spring."""
    tuned, dynamics = check.controller, ActuatorDynamics(check.controller.model)
    law = LinearLaw.of(tuned.control.program(tuned.model, tuned.parameters), tuned.model)
    linear = operating_point(dynamics, "sliding forwards", 0.0).linear
    theta, omega, i_m = (
        tuned.model.state_names.index(name) for name in ("theta", "omega", "current_motor")
    )
    command, load = (
        tuned.model.input_names.index(name) for name in ("applied_voltage_motor", "torque")
    )
    n, m = len(linear.A), len(law.F)
    rates = np.zeros((n + 3, n + 3))  # and angle and speed of the mass, the command
    rates[:n, :n], rates[:n, n + 2] = linear.A, linear.B[:, command]
    rates[:n, theta] -= spring * linear.B[:, load]
    rates[:n, omega] -= HELD * linear.B[:, load]
    rates[:n, n] += spring * linear.B[:, load]
    rates[n, n + 1] = 1.0
    rates[n + 1, [theta, n]] = spring / mass, -spring / mass
    step = expm(rates * T)
    by_angle = law.G[:, 0] - K * law.G[:, 4], law.D[0, 0] - K * law.D[0, 4]
    A = np.zeros((n + 3 + m,) * 2)
    A[: n + 2, : n + 3] = step[: n + 2]
    A[n + 2, [theta, i_m]], A[n + 2, n + 3 :] = (by_angle[1], law.D[0, 3]), law.H[0]
    A[n + 3 :, theta], A[n + 3 :, i_m], A[n + 3 :, n + 3 :] = by_angle[0], law.G[:, 3], law.F
    return np.abs(np.linalg.eigvals(A)).max()


def test_a_mass_behind_a_soft_spring_is_a_clamp_above_their_resonance(tmp_path):
    """So the promise for hands that are no clamps does not hold with it, that for any hand does."""
    plain = {"friction_share": 0.0, "inertia_share": 0.0}
    soft, clamps = (
        passivity(tmp_path, "feedforward", held=HELD, stiffest=stiffest, **plain)
        for stiffest in (40.0, np.inf)
    )
    assert ringing(soft, soft.springs_promised(), 1e-4, 40.0) > 1.002
    assert ringing(soft, soft.springs_promised(), 1e3, 40.0) < 1.0 + 1e-9
    for mass in (1e-5, 3e-5, 1e-4, 3e-4, 1e-3):
        assert ringing(clamps, clamps.springs_promised(), mass, 40.0) < 1.0 + 1e-9


class Backward(Feedforward):
    """Its observer takes the hand's torque the wrong way round."""

    def program(self, model, parameters):
        program = super().program(model, parameters)
        constants = list(program.constants)
        constants[laws.FILTER_L + 2 * laws.HAND] = -1.0
        return replace(program, constants=tuple(constants))


def test_of_a_law_that_is_unstable_by_itself_nothing_is_promised(tmp_path):
    """Its response alone would not tell."""
    plain = {"friction_share": 0.0, "inertia_share": 0.0}
    check = passivity(tmp_path, "feedforward", **plain)
    assert check.promise(COUNT).stiffness > 0.0
    control = Backward(**check.controller.control.model_dump())
    law = control.law(check.controller.model, check.controller.parameters)
    angles = [0.0] + 1599 * [1e-6]
    volts = [
        law.volts(Sample(k, k * T, 0.0, 0.0, 0.0, angle, 0.0, 0), 0.0)[0]
        for k, angle in enumerate(angles)
    ]
    assert max(np.abs(volts[1200:])) > 20.0 * max(np.abs(volts[400:800])) > 0.0
    unstable = replace(check, controller=replace(check.controller, control=control))
    with pytest.raises(UnknownPassivityError, match="unstable by itself"):
        unstable.promise(COUNT)


def test_promised_springs_come_to_rest_however_they_are_entered_and_left(tmp_path):
    """Shafts without friction, clamped commands, hands of every damping from the least on."""
    check, rng = passivity(tmp_path, "static", held=HELD), np.random.default_rng(0)
    dynamics, m = ActuatorDynamics(check.controller.model), 60
    damping = HELD * rng.choice([1.0, 1.0, 4.0], m)
    spring, lean = np.geomspace(0.04, 4.0, m), rng.uniform(-0.2, 0.5, m)
    speed = rng.choice([1.0, 10.0, 40.0], m)

    def left(K):
        """Speeds of the last half second, in parts of those before."""
        speeds = np.abs(bounced(dynamics, K, spring, damping, lean, speed))
        return speeds[-400:].max(axis=0) / speeds[:400].max(axis=0)

    assert left(0.95 * check.springs_promised()).max() < 0.05
    assert left(1.05 * check.springs_promised()).max() > 0.5


def test_of_torque_shared_with_the_brake_nothing_is_promised(tmp_path):
    with pytest.raises(UnknownPassivityError, match="allocation: heating shares"):
        passivity(tmp_path, "static", allocation="heating").promise(COUNT)


def test_of_a_law_that_takes_the_torque_sensor_nothing_is_promised(tmp_path):
    with pytest.raises(UnknownPassivityError, match="feeds the hand's torque back"):
        passivity(tmp_path, "lqg").promise(COUNT)


def test_a_port_has_the_friction_of_its_actuator(tmp_path):
    check = passivity(tmp_path, "static")
    dynamics = ActuatorDynamics(check.controller.model)
    port = check.ports[0]
    assert port.damping == pytest.approx(2e-4)
    assert port.friction == pytest.approx(abs(dynamics.rest(0.0, 0.0, dynamics.sliding, 0.0)))
