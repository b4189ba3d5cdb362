#!/usr/bin/env python3
"""K and its adjoint at the workload of `cargo bench --bench kernels` by OpenCV and PyTorch.

    benches/peers.py                          on the processor, 1 megapixel; as processor time over the number of processors
    benches/peers.py --device cuda 1 12 24    PyTorch on a GPU at so many megapixels, beside `--example gpu_times` at the same work;
                                              elapsed time between events, medians; first what the GPU's memory and arithmetic allow

pip install numpy opencv-python-headless torch, or Debian's python3-torch; the processor's figures do without either of the last two.
"""
import argparse
import os
import time

import numpy as np

ANGLES = [0.25 * k for k in range(-6, 7)]
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


def by_opencv(side):
    """13 warpAffine, 64 shifted weighted adds."""
    import cv2

    image = np.random.default_rng(1).random((side, side, 3), dtype=np.float32)
    centre = ((side - 1) / 2, (side - 1) / 2)
    turns = [cv2.getRotationMatrix2D(centre, -a, 1.0) for a in ANGLES]

    def shifted_sums():
        out = np.zeros_like(image)
        for turn, shifts in zip(turns, taps):
            warped = cv2.copyMakeBorder(cv2.warpAffine(image, turn, (side, side)), 12, 12, 12, 12, cv2.BORDER_CONSTANT)
            for dy, dx in shifts:
                cv2.scaleAdd(np.ascontiguousarray(warped[12 - dy : 12 - dy + side, 12 - dx : 12 - dx + side]), 1 / 64, out, out)
        return out

    return shifted_sums


def by_torch(torch, side, device, mode="bilinear"):
    """64 grid_sample, and the adjoint by autograd."""
    sample = torch.nn.functional.grid_sample
    source = torch.rand((1, 3, side, side), device=device, requires_grad=True)
    grids = []
    for angle, shifts in zip(ANGLES, taps):
        a, b = np.radians(angle), 2 / (side - 1)
        for dy, dx in shifts:
            theta = torch.tensor([[[np.cos(a), np.sin(a), -dx * b], [-np.sin(a), np.cos(a), -dy * b]]], dtype=torch.float32, device=device)
            grids.append(torch.nn.functional.affine_grid(theta, (1, 3, side, side), align_corners=True))

    def forward():
        out = torch.zeros_like(source)
        for g in grids:
            out = out + sample(source, g, mode=mode, align_corners=True)
        return out / 64

    return source, forward


def processor_time(f, rounds):
    f()
    times = []
    for _ in range(rounds):
        start = time.process_time()
        f()
        times.append((time.process_time() - start) * 1000 / os.cpu_count())
    return sorted(times)[rounds // 2]


def on_processor():
    try:
        print(f"OpenCV, K: {processor_time(by_opencv(1024), 5):.0f} ms")
    except ImportError:
        print("OpenCV is not installed")
    try:
        import torch
    except ImportError:
        print("PyTorch is not installed")
        return
    source, forward = by_torch(torch, 1024, "cpu")
    with torch.no_grad():
        print(f"PyTorch grid_sample, K: {processor_time(forward, 3):.0f} ms")
    seed = torch.rand_like(source)
    print(f"PyTorch, K and its adjoint (autograd): {processor_time(lambda: torch.autograd.grad(forward(), source, seed), 3):.0f} ms")


def on_gpu(megapixels):
    import torch

    def elapsed(f, rounds=5):
        f()
        times = []
        for _ in range(rounds):
            start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
            start.record()
            f()
            end.record()
            end.synchronize()
            times.append(start.elapsed_time(end))
        return sorted(times)[rounds // 2]

    torch.backends.cuda.matmul.allow_tf32 = False
    print(f"{torch.cuda.get_device_name()}, PyTorch {torch.__version__}")
    a = torch.rand(1 << 29, device="cuda")
    b = torch.empty_like(a)
    print(f"copy of 2 GiB: {2 * a.numel() * 4 / elapsed(lambda: b.copy_(a)) / 1e9:.2f} TB/s read and written")
    a, b = torch.rand(8192, 8192, device="cuda"), None
    print(f"matrix product, f32: {2 * 8192**3 / elapsed(lambda: a @ a) / 1e9:.1f} TFLOP/s")
    del a
    for size in megapixels:
        side = int((size * 1e6) ** 0.5)
        for mode in ["bilinear", "bicubic"]:
            source, forward = by_torch(torch, side, "cuda", mode)
            with torch.no_grad():
                k = elapsed(forward)
            seed = torch.rand_like(source)
            out = forward()
            adjoint = elapsed(lambda: torch.autograd.grad(out, source, seed, retain_graph=True), 3)
            print(f"{size:g} MP, {mode}: K {k:.2f} ms, adjoint (autograd) {adjoint:.2f} ms")
            del source, forward, seed, out
            torch.cuda.empty_cache()


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
parser.add_argument("megapixels", nargs="*", type=float, default=[1.0])
arguments = parser.parse_args()
if arguments.device == "cpu":
    on_processor()
else:
    on_gpu(arguments.megapixels)
