"""A strict decoder of the page's pose messages, written from docs/page.md alone."""

import struct

import numpy as np


def decoded(message: bytes) -> dict:
    """A pose message, strictly: every byte is accounted for."""
    assert message[:4] == b"TTPG" and message[4] == 1 and message[7] == 0
    k, n = struct.unpack_from("<HH", message, 8)
    number, sequence, model, vertices = struct.unpack_from("<IIII", message, 12)
    (step,) = struct.unpack_from("<f", message, 28)
    time_s, solved_s = struct.unpack_from("<dd", message, 32)
    solve_ms, age_ms, residual_mm, nothing = struct.unpack_from("<ffff", message, 48)
    assert nothing == 0
    at = 64
    weights = struct.unpack_from(f"<{k}f", message, at)
    at += 4 * k
    coils = struct.unpack_from(f"<{3 * n}f", message, at)
    at += 12 * n
    residuals = struct.unpack_from(f"<{n}f", message, at)
    at += 4 * n
    states = struct.unpack_from(f"<{n}B", message, at)
    at += n
    while at % 4:
        assert message[at] == 0
        at += 1
    mesh = struct.unpack_from(f"<{3 * vertices}h", message, at)
    assert len(message) == at + 6 * vertices
    return {
        "status": message[5], "fixed": message[6] == 1, "number": number, "sequence": sequence, "model": model,
        "time_s": time_s, "solved_s": solved_s, "solve_ms": solve_ms, "age_ms": age_ms, "residual_mm": residual_mm,
        "weights": np.array(weights), "coils": np.array(coils).reshape(-1, 3), "residuals": np.array(residuals),
        "states": states, "vertices": np.array(mesh).reshape(-1, 3) * step if vertices else None,
    }  # fmt: skip
