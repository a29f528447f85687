"""The equations of the plants to swap, written once more with NumPy from their docstrings, and a run of an FMU."""

import re
import zipfile

import numpy as np

from loopwright.fmus import Fmu

M_T, M_J = np.array([7.61, 4.41]), np.array([29.26, 16.79])  # Table II
F_C, C_V = np.array([65.42, 37.69]), np.array([175.93, 62.83])
M, WEIGHT = M_T + M_J, np.array([0.0, 9.81 * 4.41])
FREE = {"coulomb_scale": 0.0, "viscous_scale": 0.0, "gravity": 0.0}


def run(file, T, start=None, **inputs):
    """Run an FMU from tick to tick, its inputs held; return its outputs by name, one row more than of the inputs."""
    plant = Fmu(file, name="plant", start=start or {})
    rows = np.concatenate([np.reshape(v, (len(v), -1)) for v in inputs.values()], axis=1)
    u, y = np.zeros(rows.shape[1]), np.zeros(sum(int(np.prod(p.shape)) for p in plant.outputs.values()))
    with plant.instantiate(list(inputs), T * len(rows)) as instance:
        instance.bind(u, y)
        instance.begin()
        found = [y.copy()]
        for k, row in enumerate(rows):
            u[:] = row
            instance.step(k * T, T)
            found.append(y.copy())
    found, at, result = np.array(found), 0, {}
    for name, port in plant.outputs.items():
        n = int(np.prod(port.shape))
        result[name] = found[:, at] if port.shape == () else found[:, at : at + n]
        at += n
    return result


K, D = np.array([2.4e6, 1.4e6]), np.array([900.0, 530.0])


def friction(v, w=0.01):
    return F_C * np.tanh(v / w) + C_V * v


def elastic(x, u, f, share=0.5):
    s, v, sm, vm = np.reshape(x, (4, 2))  # slide and motor, each with its own velocity
    screw = K * (sm - s) + D * (vm - v)
    slide = (screw - share * friction(v) - WEIGHT + f) / M_T
    motor = (u - screw - (1 - share) * friction(vm)) / M_J
    return np.concatenate([v, slide, vm, motor])


F_S, V_S = np.array([85.0, 49.0]), 0.005
S0, S1 = np.array([2.2e6, 1.25e6]), np.array([9000.0, 5100.0])


def stribeck(v):
    return F_C + (F_S - F_C) * np.exp(-((v / V_S) ** 2))


def lugre(v, z, coulomb=1.0, viscous=1.0):
    rate = v - S0 * np.abs(v) * z / stribeck(v)
    return rate, coulomb * (S0 * z + S1 * rate) + viscous * C_V * v


def sticking(x, u, f, *scales):
    v, z = x[2:4], x[4:]
    rate, force = lugre(v, z, *scales)
    return np.concatenate([v, (u - force - WEIGHT + f) / M, rate])


def hidden(file, folder, *, saves=True):
    """The same FMU, that doesn't say which its states are, and has no derivatives."""
    path = folder / f"hidden_{saves}_{file.name}"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                text = re.sub(r"<ContinuousStateDerivative[^>]*/>", "", data.decode())
                text = text.replace('providesDirectionalDerivatives="true"', "")
                if not saves:
                    text = re.sub(r'can(GetAndSet|Serialize)FMUState="true"', "", text)
                data = text.encode()
            new.writestr(item, data)
    return path


def undirected(file, folder):
    """The FMU without its directional derivatives: its linear models are differences."""
    path = folder / "undirected.fmu"
    with zipfile.ZipFile(file) as old, zipfile.ZipFile(path, "w") as new:
        for item in old.namelist():
            data = old.read(item)
            if item == "modelDescription.xml":
                data = data.replace(b'providesDirectionalDerivatives="true"', b"")
            new.writestr(item, data)
    return path
