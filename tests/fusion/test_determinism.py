"""The fused bytes must not depend on the processor: no BLAS, no LAPACK, no numpy transcendental in fusion/.

numpy picks its loops by the processor's features; its `exp` then differs in the last bit. One test takes features
away in processes of their own, which say what numpy has left, and compares the bytes; the other reads the source.
"""

from __future__ import annotations

import ast
import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

FUSION = Path(__file__).resolve().parents[2] / "edge_agent" / "fusion"
ALLOWED_NUMPY = {
    # construction, views, indexing
    "array", "asarray", "empty", "empty_like", "zeros", "zeros_like", "ones", "full", "arange", "concatenate", "stack",
    "broadcast_to", "flatnonzero", "count_nonzero", "where", "isfinite", "ndarray",
    # arithmetic that IEEE 754 defines to the last bit, and sorting
    "sqrt", "abs", "subtract", "maximum", "minimum", "multiply", "clip", "diff", "sort", "diag", "swapaxes",
    # types
    "float64", "int64", "uint8",
}  # fmt: skip
"""What fusion/ may use of numpy. A new name belongs here only if every processor rounds it alike."""


def _digest() -> str:
    """Of everything that a station gives for a minute of motion with a jump, a gap and an outage."""
    from fusion_play import T0, S, accel_items, blocks_of, bridge, fix_items, play

    from edge_agent.messages import PointSettings
    from edge_agent.state import pack

    t, a, _, tf, z, _ = bridge(60.0, offset_ns=3_000_001)
    z = z.copy()
    z[300:340] += [0.08, 0.0, -0.05]
    keep = (t < T0 + 22 * S) | (t > T0 + 22 * S + 400_000_000)
    seen = (tf < T0 + 42 * S) | (tf > T0 + 50 * S)
    points = [PointSettings("p", "r", "a"), PointSettings("g", "r", None), PointSettings("v", None, "a")]
    p = play(
        accel_items(t[keep], a[keep], blocks_of(t[keep])) + fix_items(tf[seen], z[seen], 150_000_000), points=points
    )
    h = hashlib.sha256()
    for e in p.estimates:
        h.update(pack([e.point, e.t_ns, e.displacement_m, e.velocity_mps, e.std_displacement_m, e.std_velocity_mps]))
        h.update(pack([e.mode, e.flags, e.bias_mps2, e.std_bias_mps2, e.offset_m, e.std_offset_m]))
    for i in p.innovations:
        h.update(pack([i.point, i.t_ns, i.residual_m, i.variance_m2, i.ratio, int(i.verdict), i.std_m, i.offset_m]))
    for v in p.events:
        h.update(pack([v.t_ns, v.kind, v.source, v.text, [list(x) for x in v.values], v.begin_ns, v.end_ns]))
    h.update(pack(p.station.save()))
    assert {e.kind for e in p.events} >= {"START", "JUMP_OPEN", "ACCEL_GAP", "OUTAGE_END"}
    return h.hexdigest()


def _run(disabled: str) -> tuple[str, set[str]]:
    """The digest in a process without these features, and those of numpy's loops that are left to it."""
    env = {**os.environ, "NPY_DISABLE_CPU_FEATURES": disabled, "PYTHONPATH": os.pathsep.join(sys.path)}
    if not disabled:
        del env["NPY_DISABLE_CPU_FEATURES"]
    code = "import warnings; warnings.simplefilter('ignore'); import test_determinism as t; "
    code += "print(t._digest(), *t._features())"
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
    )
    fused, *features = done.stdout.split()
    return fused, set(features)


def _features() -> list[str]:
    """numpy's dispatch targets beyond its baseline that this processor has, best first."""
    umath = np._core._multiarray_umath
    return [f for f in reversed(umath.__cpu_dispatch__) if umath.__cpu_features__.get(f)]


def test_bytes_do_not_depend_on_the_processors_features() -> None:
    features = _features()
    if not features:
        pytest.skip("this processor has none of the features that numpy dispatches on")
    fused, left = _run("")
    assert left >= set(features)
    for k in range(1, len(features) + 1):
        other, left = _run(" ".join(features[:k]))
        assert not left & set(features[:k]), "the setting did nothing, so equal bytes would prove nothing"
        assert other == fused


def _names(tree: ast.AST) -> set[str]:
    """np.<name> and np.<a>.<b> used in a module."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("np", "numpy"):
            found.add(node.attr)
    return found


@pytest.mark.parametrize("path", sorted(FUSION.glob("*.py")), ids=lambda p: p.name)
def test_source_uses_nothing_that_processors_round_differently(path: Path) -> None:
    tree = ast.parse(path.read_text())
    assert _names(tree) <= ALLOWED_NUMPY
    for node in ast.walk(tree):
        if isinstance(node, (ast.BinOp, ast.AugAssign)):
            assert not isinstance(node.op, ast.MatMult), f"line {node.lineno}: matrix product"
            if isinstance(node.op, ast.Pow):
                power = node.right if isinstance(node, ast.BinOp) else node.value
                plain = isinstance(power, ast.Constant) and isinstance(power.value, int)
                base = node.left if isinstance(node, ast.BinOp) else node.target
                scalar = isinstance(base, ast.Constant)  # a grid of constants, scalar Python
                assert plain or scalar, f"line {node.lineno}: power with an exponent that is not an integer literal"
        if isinstance(node, ast.Attribute):
            assert node.attr not in {
                "dot",
                "matmul",
                "linalg",
                "inv",
                "solve",
                "tensordot",
                "vdot",
                "mean",
                "std",
                "var",
            }, f"line {node.lineno}: {node.attr}"
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            for name in names:
                root = name.split(".")[0]
                assert root in {
                    "__future__",
                    "collections",
                    "dataclasses",
                    "enum",
                    "math",
                    "typing",
                    "numpy",
                    "edge_agent",
                }
                if root == "edge_agent":
                    assert name.startswith(("edge_agent.fusion", "edge_agent.messages"))


def test_the_source_test_can_fail() -> None:
    assert not _names(ast.parse("import numpy as np\ny = np.exp(x)")) <= ALLOWED_NUMPY
    assert not _names(ast.parse("import numpy as np\ny = np.linalg.inv(x)")) <= ALLOWED_NUMPY
