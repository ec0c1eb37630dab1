"""The equations of the actuator written out once more, to hold the model against.

Nothing here comes from the project. Each derivative is the sum of the terms as they stand in
the thesis, so that a difference can be judged by the size of what it is made of. States, inputs
and parameters are dictionaries by name.
"""

from __future__ import annotations

import math

SUPPLY, MAX_CURRENT, FOLDBACK = 24.0, 2.5, 100.0
GRAVITY, CROSSOVER = 9.80665, 0.1


def within(value, limit):
    return sorted((-limit, value, limit))[1]


def rates(parts, q, x, u):
    """Terms of each state's derivative, by name."""
    x = at_rest(parts, x)
    found = electrical_rates(parts, q, x, u)
    found["z"] = hysteresis_rate(parts, q, x["omega"], x["z"])
    found["theta"] = [x["omega"]]
    found["omega"] = [torque / total_inertia(parts, q) for torque in torques(parts, q, x, u)]
    if "pulley" in parts.load:
        found["height"] = [x["speed"]]
        found["speed"] = [
            cable_tension(q, x) / q["mass"],
            -stop_force(q, x) / q["mass"],
            -GRAVITY,
        ]
    if parts.load == "locked":
        found["omega"] = [0.0]
    return found


def at_rest(parts, x):
    """A locked shaft does not turn, whatever its state says."""
    return x | {"omega": 0.0} if parts.load == "locked" else x


def electrical_rates(parts, q, x, u):
    """(3.7) or (3.10) with (3.1) for the motor and (3.3) for the brake; the amplifier's limits."""
    found = {}
    for channel, k, emf in (("motor", "m", q["n_c"] * q["K_m"] * x["omega"]), ("brake", "b", 0.0)):
        i, command = x[f"current_{channel}"], u[f"applied_voltage_{channel}"]
        order = getattr(parts, f"order_{channel}")
        names = [f"voltage_{channel}", f"voltage_{channel}_2", f"voltage_{channel}_3"][:order]
        cutoffs = [q[f"omega_d{k}{n}"] for n in ("", "2", "3")[:order]]
        cutoff, fed_back = cutoffs[-1], [-cutoffs[-1] * x[name] for name in names]
        for n in range(order - 1):
            found[names[n]] = [cutoffs[n] * x[names[n + 1]]]
        if getattr(parts, f"driver_{channel}") == "closed":
            K, asked = q[f"K_d{k}"], q["K_v2i"] * command
            if parts.limits:
                asked = within(asked, MAX_CURRENT)
            found[names[-1]] = [*fed_back, -K * cutoff * i, K * cutoff * asked]
        else:
            beyond = i - within(i, MAX_CURRENT) if parts.limits else 0.0
            found[names[-1]] = [
                *fed_back,
                q[f"G_d{k}"] * cutoff * command,
                -FOLDBACK * cutoff * beyond,
            ]
        v = x[f"voltage_{channel}"]
        across = within(v, SUPPLY) if parts.limits else v
        R, L = q[f"R_{k}"], q[f"L_{k}"]
        if getattr(parts, f"output_resistance_{channel}"):
            R += q[f"R_o{k}"]
        found[f"current_{channel}"] = [emf / L, -R / L * i, across / L]
    return found


def hysteresis_rate(parts, q, omega, z):
    """(3.14), (3.16), (3.18) or their smooth forms (3.26), (3.27), (3.28)."""
    if parts.hysteresis == "bouc-wen":
        n, gamma, beta, A = parts.exponent, q["gamma"], q["beta"], q["A"]
        if parts.smooth:
            rho = q["rho"]
            size = (math.tanh(rho * z) * z) ** n
            turned = math.tanh(rho * omega * z)
            return [omega * A, -omega * size * beta, -omega * size * gamma * turned]
        return [
            -gamma * abs(omega) * z * abs(z) ** (n - 1.0),
            -beta * omega * abs(z) ** n,
            A * omega,
        ]
    sign = math.tanh(q["rho"] * omega) if parts.smooth else math.copysign(1.0, omega)
    if parts.hysteresis == "dahl":
        return [q["sigma"] * omega, -q["sigma"] * omega * z * sign]
    return [omega, -q["zeta"] * omega * sign * z]


def brake_torque(parts, q, x):
    """Terms of (3.15), (3.17) or (3.19), with the size of the current."""
    i = abs(x["current_brake"])
    terms = [
        (q["alpha0"] + q["alpha1"] * i) * x["z"],
        (q["c0"] + q["c1"] * i) * x["omega"],
    ]
    if parts.hysteresis == "lugre":
        terms.append(
            (q["epsilon0"] + q["epsilon1"] * i) * sum(hysteresis_rate(parts, q, x["omega"], x["z"]))
        )
    return terms


def brush_torque(parts, q, x):
    """Terms of the brushes' friction."""
    if parts.friction == "none":
        return []
    omega, theta = x["omega"], x["theta"]
    sign = math.tanh(omega / q["omega_r"])
    terms = [
        q["F_c"] * sign,
        (q["F_s"] - q["F_c"]) * math.exp(-((omega / q["omega_s"]) ** 2)) * sign,
        q["B_f"] * omega,
    ]
    if parts.friction == "cyclic":
        terms += [
            q["F_cos"] * math.cos(q["cycles"] * theta) * sign,
            q["F_sin"] * math.sin(q["cycles"] * theta) * sign,
        ]
    return terms


def motor_torque(q, x):
    """Terms of the motor's torque on the shaft, less its bearings' (3.21)."""
    return [-q["n_c"] * q["K_m"] * x["current_motor"], -(q["n_c"] ** 2) * q["B_m"] * x["omega"]]


def load_torque(parts, q, x, u):
    """Terms of the torque that comes from outside."""
    terms = []
    if parts.load == "measured":
        terms.append(u["torque"])
    if "pulley" in parts.load:
        terms.append(-cable_tension(q, x) * cable_lever(q, x))
    if "hand" in parts.load:
        terms += [
            u["hand_grip"] * q["B_u"] * (u["hand_omega"] - x["omega"]),
            u["hand_grip"] * q["K_u"] * (u["hand_theta"] - x["theta"]),
        ]
    return terms


def torques(parts, q, x, u):
    """Terms of all that accelerates the shaft (3.22)."""
    resisting = brake_torque(parts, q, x) + brush_torque(parts, q, x)
    return motor_torque(q, x) + [-term for term in resisting] + load_torque(parts, q, x, u)


def rotor_inertia(q):
    """J of (3.22)."""
    return q["n_c"] ** 2 * q["J_m"] + q["J_b"]


def pulley_inertia(parts, q):
    return q["J_p"] if "pulley" in parts.load else 0.0


def total_inertia(parts, q):
    return rotor_inertia(q) + pulley_inertia(parts, q)


def cable_path(q, theta):
    """Length of cable on the pulley, the same whichever way it is wound [m]."""
    return q["radius"] * (math.sqrt(theta**2 + CROSSOVER**2) - CROSSOVER)


def cable_lever(q, x):
    """d path / d theta [m]."""
    return q["radius"] * x["theta"] / math.sqrt(x["theta"] ** 2 + CROSSOVER**2)


def cable_stretch(q, x):
    return max(0.0, cable_path(q, x["theta"]) - x["height"])


def cable_tension(q, x):
    """A spring with Hunt and Crossley's loss, which never pushes [N]."""
    rate = cable_lever(q, x) * x["omega"] - x["speed"]
    return q["k_cable"] * cable_stretch(q, x) * max(0.0, 1.0 + q["d_cable"] * rate)


def stop_force(q, x):
    """What the pulley pushes the mass down with, once all cable is wound [N]."""
    pressed = max(0.0, x["height"] - q["length"])
    return q["k_cable"] * pressed * max(0.0, 1.0 + q["d_cable"] * x["speed"])


def sensor_reading(parts, q, x, u, acceleration):
    """Terms of the torque at the sensor, from what is on the side the model does not use.

    A sensor at the load carries what the motor, brake and brushes leave over; one between motor
    and brake what brake, brushes and load need, or on a locked shaft the motor's torque.
    """
    x = at_rest(parts, x)
    resisting = brake_torque(parts, q, x) + brush_torque(parts, q, x)
    if parts.sensor == "load":
        left = [-term for term in motor_torque(q, x)] + resisting
        return [*left, rotor_inertia(q) * acceleration]
    if parts.load == "locked":
        return motor_torque(q, x)
    right = resisting + [-term for term in load_torque(parts, q, x, u)]
    return [*right, (q["J_b"] + pulley_inertia(parts, q)) * acceleration]
