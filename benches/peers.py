#!/usr/bin/env python3
"""K of the workload of `cargo bench --bench kernels` by OpenCV and, where it is installed, by PyTorch, on the same cores.

pip install numpy opencv-python-headless, and for the second part torch (the CPU build is about 200 MB).
Times are processor time over the number of processors, as in the benchmark.
"""
import os
import time

import cv2
import numpy as np

SIDE, ANGLES = 1024, [0.25 * k for k in range(-6, 7)]
state = 1


def number(n):
    global state
    state = (state * 747796405 + 2891336453) & 0xFFFFFFFF
    return (state >> 16) % n


taps, x, y = [], 0, 0
for base in range(13):
    at = set()
    while len(at) < (4 if base == 6 else 5):
        at.add((y, x))
        x = max(-12, min(12, x + number(3) - 1))
        y = max(-12, min(12, y + number(3) - 1))
    taps.append(sorted(at))

image = np.random.default_rng(1).random((SIDE, SIDE, 3), dtype=np.float32)
centre = ((SIDE - 1) / 2, (SIDE - 1) / 2)
turns = [cv2.getRotationMatrix2D(centre, -a, 1.0) for a in ANGLES]


def shifted_sums():
    """13 warpAffine, 64 shifted weighted adds."""
    out = np.zeros_like(image)
    for turn, shifts in zip(turns, taps):
        warped = cv2.copyMakeBorder(cv2.warpAffine(image, turn, (SIDE, SIDE)), 12, 12, 12, 12, cv2.BORDER_CONSTANT)
        for dy, dx in shifts:
            cv2.scaleAdd(np.ascontiguousarray(warped[12 - dy : 12 - dy + SIDE, 12 - dx : 12 - dx + SIDE]), 1 / 64, out, out)
    return out


def measure(name, f, rounds=5):
    f()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        f()
        times.append((time.process_time() - start) * 1000 / os.cpu_count())
    print(f"{name}: {sorted(times)[rounds // 2]:.0f} ms")


measure("OpenCV, K", shifted_sums)
try:
    import torch
except ImportError:
    print("PyTorch is not installed")
else:
    source = torch.from_numpy(image).permute(2, 0, 1)[None].contiguous().requires_grad_()
    grids = []
    for turn, shifts in zip(turns, taps):
        a, b = np.radians(ANGLES[len(grids) // 5]), 2 / (SIDE - 1)
        for dy, dx in shifts:
            theta = torch.tensor([[[np.cos(a), np.sin(a), -dx * b], [-np.sin(a), np.cos(a), -dy * b]]], dtype=torch.float32)
            grids.append(torch.nn.functional.affine_grid(theta, (1, 3, SIDE, SIDE), align_corners=True))

    def forward():
        return sum(torch.nn.functional.grid_sample(source, g, align_corners=True) for g in grids) / 64

    with torch.no_grad():
        measure("PyTorch grid_sample, K", forward, 3)
    seed = torch.rand_like(source)

    def both():
        source.grad = None
        forward().backward(seed)

    measure("PyTorch, K and its adjoint (autograd)", both, 3)
