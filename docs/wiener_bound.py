#!/usr/bin/env python3
"""What do the shaken frames of a bracket know that its sharp ones do not? The PU21-PSNR of the luminance that a Wiener filter reaches which knows
the true spectrum of every part of the scene (squares of 32 px), the noise and the blurs, from the sharp frames alone and from all:
  wiener_bound.py --benchmark DIR BRACKET...
DIR holds the benchmark's run.py, BRACKET is a folder that it made. Noise counts as Gaussian, a blur as the same all over a frame: its shifts about the centre."""
import argparse, json, os, sys
import numpy as np

SIDE, STEP, BORDER = 32, 16, 24


def powers(bracket, tsfs):
    """|FFT of the PSF|^2 of each frame, 1 where it is sharp."""
    fy, fx = np.fft.fftfreq(SIDE)[:, None], np.fft.fftfreq(SIDE)[None]
    shaken = {f["frame"]: f["poses"] for f in tsfs["frames"]}
    for name in bracket["frames"]:
        poses = shaken.get(name, [])
        weights = np.array([p["weight"] for p in poses])
        waves = [np.exp(-2j * np.pi * (fx * p["t_x"] + fy * p["t_y"])) for p in poses]
        yield np.abs(np.tensordot(weights / weights.sum(), waves, 1)) ** 2 if poses else np.ones((SIDE, SIDE))


def variance(x, bracket):
    """Of an exposure x (1 = white) of three channels' mean: shot noise, read noise, rounding of sRGB codes."""
    full, read = bracket["full_well"], bracket["read_noise"]
    code = max(255 * x ** (1 / 2.2), 1)
    return (x / full + (read / full) ** 2 + (2.2 * x / code) ** 2 / 12) / 3


def bound(folder, pu21):
    read = lambda name: json.load(open(os.path.join(folder, name)))
    bracket, truth = read("bracket.json"), np.load(os.path.join(folder, "truth.npy")).mean(2)
    gain = 1000 / np.percentile(truth, 99.5)
    seen, white = pu21(truth * gain), pu21(np.array(1000.0))
    frames = list(zip(bracket["exposures"], [m["sharp"] for m in bracket["meta"]], powers(bracket, read("truth_tsf.json"))))
    window = np.outer(*[np.hanning(SIDE + 2)[1:-1]] * 2)
    window /= np.sqrt((window**2).mean())
    left = {"sharp": [], "all": []}
    for y in range(BORDER, truth.shape[0] - BORDER - SIDE, STEP):
        for x in range(BORDER, truth.shape[1] - BORDER - SIDE, STEP):
            part = (slice(y, y + SIDE), slice(x, x + SIDE))
            e = float(np.median(truth[part]))
            slope = (pu21(np.array(1.01 * e * gain)) - pu21(np.array(0.99 * e * gain))) / (0.02 * e)
            spectrum = np.abs(np.fft.fft2((seen[part] - seen[part].mean()) * window)) ** 2 / SIDE**2
            spectrum = sum(np.roll(spectrum, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
            for which, errors in left.items():
                known = [p * t**2 / (variance(e * t, bracket) * slope**2) for t, s, p in frames if e * t < 0.98 and (s or which == "all")]
                if known:
                    errors.append((spectrum / (1 + spectrum * sum(known))).mean())
    return [10 * np.log10(white**2 / np.mean(left[which])) for which in ("sharp", "all")]


def main():
    words = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    words.add_argument("--benchmark", required=True)
    words.add_argument("bracket", nargs="+")
    words = words.parse_args()
    sys.path.insert(0, words.benchmark)
    from metrics import pu21

    for folder in words.bracket:
        sharp, all_frames = bound(folder, pu21)
        print(f"{os.path.basename(os.path.normpath(folder))}: sharp frames {sharp:.2f} dB, all {all_frames:.2f}, gained {all_frames - sharp:.2f}")


if __name__ == "__main__":
    main()
