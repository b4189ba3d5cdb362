#!/usr/bin/env python3
"""What does a bracket lose because its frames lie between each other's pixels? The PU21-PSNR of the luminance that a Wiener filter reaches which knows the
true spectrum of every part of the scene (squares of 32 px) on a grid twice as fine as the pixels, the noise, the blurs and how pixels sum and alias, from
frames that are displaced and from the same frames in place:
  displaced_bound.py --benchmark DIR [--case A-shifted] [--lens PX] SCENE...
DIR holds the benchmark's run.py, SCENE is one of its scenes (a file); PX: standard deviation of a lens's blur in pixels (0: none, as in the benchmark).
Noise counts as Gaussian, a motion as the same all over a square, up to what it is at its middle."""
import argparse, json, os, sys, tempfile, zlib
import numpy as np
from wiener_bound import BORDER, SIDE, STEP, variance

FINE = 2 * SIDE


def seen_from(shifts, frequencies):
    """What bilinear reading at each of the shifts (fine pixels, one axis) passes of each frequency."""
    whole = np.floor(shifts)[:, None]
    part = shifts[:, None] - whole
    wave = lambda k: np.exp(2j * np.pi * frequencies * k)
    return (1 - part) * wave(whole) + part * wave(whole + 1)


def aliases(spectrum):
    """Last axis: the four fine frequencies that a grid of every second sample takes for the same one."""
    return np.stack([spectrum[i : i + SIDE, j : j + SIDE] for i in (0, SIDE) for j in (0, SIDE)], -1)


def bound(folder, scene, margin, synth, pu21):
    read = lambda name: json.load(open(os.path.join(folder, name)))
    bracket, truth = read("bracket.json"), np.load(os.path.join(folder, "truth.npy"))
    h, w = truth.shape[:2]
    fine = scene[2 * margin :, 2 * margin :][: 2 * h, : 2 * w]
    fine = (fine * np.median(truth / fine.reshape(h, 2, w, 2, 3).mean((1, 3)))).mean(2)
    truth = truth.mean(2)
    gain = 1000 / np.percentile(truth, 99.5)
    seen, white = pu21(fine * gain), pu21(np.array(1000.0))
    window = np.outer(*[np.hanning(FINE + 2)[1:-1]] * 2)
    window /= np.sqrt((window**2).mean())
    frequencies = np.fft.fftfreq(FINE)
    half = (1 + np.exp(-2j * np.pi * frequencies)) / 2
    pixel = np.outer(half, half)
    centre = ((w - 1) / 2, (h - 1) / 2)
    # Of a path a few hundred poses tell all there is to tell.
    some = lambda poses: poses[:: max(1, len(poses) // 200)]
    motions = [[np.linalg.inv(synth.pose_homography(p, bracket["focal_px"], centre)) for p in some(m["poses"])] for m in bracket["meta"]]
    errors = []
    for y in range(BORDER, h - BORDER - SIDE, STEP):
        for x in range(BORDER, w - BORDER - SIDE, STEP):
            e = float(np.median(truth[y : y + SIDE, x : x + SIDE]))
            slope = (pu21(np.array(1.01 * e * gain)) - pu21(np.array(0.99 * e * gain))) / (0.02 * e)
            part = seen[2 * y : 2 * y + FINE, 2 * x : 2 * x + FINE]
            power = np.abs(np.fft.fft2((part - part.mean()) * window)) ** 2 / FINE**2
            power = aliases(sum(np.roll(power, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9) / 4
            passed, noise = [], []
            middle = np.array([x + SIDE / 2, y + SIDE / 2, 1])
            for t, poses in zip(bracket["exposures"], motions):
                if e * t < 0.98:
                    there = np.array([m @ middle for m in poses])
                    shifts = 2 * (there[:, :2] / there[:, 2:] - middle[:2])
                    blur = seen_from(shifts[:, 1], frequencies).T @ seen_from(shifts[:, 0], frequencies) / len(poses)
                    passed.append(aliases(pixel * blur))
                    noise.append(variance(e * t, bracket) * slope**2 / t**2)
            if passed:
                passed, wanted = np.stack(passed, -2), aliases(pixel)
                observed = np.einsum("...ka,...a,...la->...kl", passed, power, passed.conj()) + np.diag(noise)
                shared = np.einsum("...ka,...a,...a->...k", passed, power, wanted.conj())
                known = np.einsum("...k,...k->...", shared.conj(), np.linalg.solve(observed, shared[..., None])[..., 0]).real
                errors.append(((np.abs(wanted) ** 2 * power).sum(-1) - known).mean())
    return 10 * np.log10(white**2 / np.mean(errors))


def main():
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--benchmark", required=True)
    words.add_argument("--case", default="A-shifted")
    words.add_argument("--lens", type=float, default=0)
    words.add_argument("scene", nargs="+")
    words = words.parse_args()
    sys.path.insert(0, words.benchmark)
    import cv2, run, synth
    from metrics import pu21

    numbers = {k: v for k, v in run.CASES[words.case][0].items() if k != "options"}
    margin = numbers.get("margin", 48)
    for path in words.scene:
        name = os.path.splitext(os.path.basename(path))[0]
        scene = run.load_scene(path)
        smaller = 2 * (360 + 2 * margin) / scene.shape[1]
        if smaller < 1:
            scene = cv2.resize(scene, None, fx=smaller, fy=smaller, interpolation=cv2.INTER_AREA)
        if words.lens:
            scene = cv2.GaussianBlur(scene, (0, 0), 2 * words.lens)
        seed = zlib.crc32((name + words.case).encode()) % 2**31
        found = []
        # A displacement of next to nothing: the same shakes and the same noise.
        for shift in (numbers["shift_px"], 1e-6):
            with tempfile.TemporaryDirectory() as folder:
                synth.make_bracket(scene, folder, seed=seed, **{**numbers, "shift_px": shift})
                found.append(bound(folder, scene, margin, synth, pu21))
        print(f"{name}: displaced {found[0]:.2f} dB, in place {found[1]:.2f}, lost {found[1] - found[0]:.2f}", flush=True)


if __name__ == "__main__":
    main()
