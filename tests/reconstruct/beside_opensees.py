"""Our forward solve beside OpenSees (corotational beams): the elastica at λ = 10, same elements, same run, one thread.

Not a test: OpenSees (``pip install openseespy``) is not a dependency. Prints a row an element count; each solver takes
the largest load step with which it converges.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.special import ellipeinc, ellipk, ellipkinc

from reconstruct.beam import Beam
from reconstruct.equilibrium import solve
from reconstruct.loads import Loads

LAMBDA, LENGTH_M, EI, GJ, EA = 10.0, 1.0, 1.0, 1.0, 1e6
REPEATS = 20


def exact() -> float:
    """w / L of the tip (elliptic integrals)."""
    from scipy.optimize import brentq

    def excess(k: float) -> float:
        return float(ellipk(k * k) - ellipkinc(np.arcsin(1 / (k * np.sqrt(2))), k * k) - np.sqrt(LAMBDA))

    k = brentq(excess, np.sqrt(0.5) + 1e-12, 1 - 1e-12)
    phi = np.arcsin(1 / (k * np.sqrt(2)))
    return float(1 - 2 / np.sqrt(LAMBDA) * (ellipeinc(np.pi / 2, k * k) - ellipeinc(phi, k * k)))


def ours(n: int) -> float:
    beam = Beam(
        np.full(n, LENGTH_M / n),
        np.tile(np.diag([EA, GJ, EI, EI]), (n, 1, 1)),
        np.zeros((n, 3)),
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros(3),
        np.eye(3),
    )
    force = np.zeros((n + 1, 3))
    force[-1, 2] = LAMBDA * EI / LENGTH_M**2
    found = solve(beam, Loads(force, np.zeros((n + 1, 3))))
    assert found.converged
    return float(found.shape.position_m[-1, 2])


def opensees(ops: Any, n: int, steps: int) -> float:
    ops.wipe()
    ops.model("basic", "-ndm", 3, "-ndf", 6)
    for i in range(n + 1):
        ops.node(i, LENGTH_M * i / n, 0.0, 0.0)
    ops.fix(0, 1, 1, 1, 1, 1, 1)
    ops.geomTransf("Corotational", 1, 0.0, 0.0, 1.0)
    for i in range(n):
        ops.element("elasticBeamColumn", i, i, i + 1, EA, 1.0, 1.0, GJ, EI, EI, 1)
    ops.timeSeries("Linear", 1)
    ops.pattern("Plain", 1, 1)
    ops.load(n, 0.0, 0.0, LAMBDA * EI / LENGTH_M**2, 0.0, 0.0, 0.0)
    ops.constraints("Plain")
    ops.numberer("RCM")
    ops.system("BandGeneral")
    ops.test("NormDispIncr", 1e-10, 60, 0)
    ops.algorithm("Newton")
    ops.integrator("LoadControl", 1.0 / steps)
    ops.analysis("Static")
    return float(ops.nodeDisp(n, 3)) if ops.analyze(steps) == 0 else float("nan")


def timed(run: Callable[[], float]) -> tuple[float, float]:
    run()
    begin = time.perf_counter()
    for _ in range(REPEATS):
        value = run()
    return value, 1e3 * (time.perf_counter() - begin) / REPEATS


def main() -> None:
    """Print the table."""
    import openseespy.opensees as ops

    print(f"elastica, λ = {LAMBDA:g}: w/L = {exact():.8f}")
    for n in (16, 30, 60):
        value, ms = timed(lambda n=n: ours(n))
        print(f"{n:3d} elements  ours      {ms:8.2f} ms  1 load step    error {value - exact():+.2e}")
        for steps in (1, 2, 5, 10, 20, 50, 100):
            if np.isfinite(opensees(ops, n, steps)):
                value, ms = timed(lambda n=n, steps=steps: opensees(ops, n, steps))
                print(f"{n:3d} elements  OpenSees  {ms:8.2f} ms  {steps} load steps  error {value - exact():+.2e}")
                break
        else:
            print(f"{n:3d} elements  OpenSees  does not converge in 100 load steps")


if __name__ == "__main__":
    main()
