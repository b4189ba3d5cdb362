#!/usr/bin/env python3
"""What a result of a bracket without a sharp frame is worth where it lies.

Such a result lies wherever the reference frame's mean pose was, and the benchmark brings its truth there by Lanczos interpolation.
Point lamps and hard edges that were photographed without a lens before the pixels ring under it, by several dB on some scenes,
whereas a result at the truth's own place is judged without. Here the truth is rendered at the result's place from the scene at
twice the pixels, as the benchmark renders its frames.

  rendered_truth.py --benchmark FOLDER judge BRACKET RESULT.exr ...
      BRACKET is a folder SCENE-CASE that the benchmark's run.py left in its --work folder (of its default --size); prints PU21-PSNR
      and edge ratio as run.py does, and against the rendered truth, and the pose (t_x, t_y in pixels, roll in degrees) of the result.
  rendered_truth.py --benchmark FOLDER place BRACKET OUT.json
      the true TSFs about the mean pose of the bracket's first frame, for merge --tsf: its result lies where an estimate's does.
"""
import argparse
import json
import os
import sys

import cv2
import numpy as np
from scipy.optimize import minimize

BORDER = 30  # pixels from the frame's border that do not count for the place
WIDTH = 360  # of the benchmark's frames


def scene_of(bracket, run, scenes):
    """The scene at twice the pixels, the frame's size and its margin, as run.py makes them."""
    scene, case = os.path.basename(os.path.normpath(bracket)).split("-", 1)
    data = run.load_scene(os.path.join(scenes, scene + ".exr"))
    margin = run.CASES[case][0].get("margin", 48)
    s = 2 * (WIDTH + 2 * margin) / data.shape[1]
    if s < 1:
        data = cv2.resize(data, None, fx=s, fy=s, interpolation=cv2.INTER_AREA)
    size = data.shape[0] // 2 - 2 * margin, data.shape[1] // 2 - 2 * margin
    return data[: 2 * (size[0] + 2 * margin), : 2 * (size[1] + 2 * margin)], size, margin


def start(warp, size):
    """Pose (t_x, t_y, roll) of the frame whose pixels `warp` takes to the truth's."""
    centre = (np.array(size[::-1]) - 1) / 2
    angle = np.arctan2(warp[1, 0], warp[0, 0])
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = -turn.T @ (turn @ centre + warp[:, 2] - centre)
    return np.array([*shift, -np.rad2deg(angle)])


def judge(bracket, files, scenes, run, metrics, synth):
    scene, size, margin = scene_of(bracket, run, scenes)
    b = json.load(open(os.path.join(bracket, "bracket.json")))
    truth, limit = np.load(os.path.join(bracket, "truth.npy")), 0.98 / min(b["exposures"])
    at = lambda p: synth.blur(scene, [(p[0], p[1], 0, 0, p[2])], size, margin, b["focal_px"])
    gain = truth.mean() / at((0, 0, 0)).mean()
    inner = lambda image: metrics.log_lum(image)[BORDER:-BORDER, BORDER:-BORDER]
    for file in files:
        result = run.read_exr(file)
        seen = inner(result)

        def away(p):
            d = inner(gain * at(p)) - seen
            return float(np.abs(d - np.median(d)).mean())

        first = start(metrics.rigid_warp(result, truth), size)
        simplex = first + np.array([[0, 0, 0], [0.15, 0, 0], [0, 0.15, 0], [0, 0, 0.05]])
        pose = minimize(away, first, method="Nelder-Mead", options=dict(initial_simplex=simplex, maxiter=60, xatol=1e-3, fatol=1e-7)).x
        rows = metrics.score(result, truth, True, limit=limit), metrics.score(result, gain * at(pose), limit=limit)
        words = [f"{r['pu_psnr']:.2f} ({r['edge_ratio']:.2f})" for r in rows]
        print(f"{file}: interpolated {words[0]}, rendered {words[1]}, at {', '.join(f'{v:.3f}' for v in pose)}")


def place(bracket, out):
    tsfs = json.load(open(os.path.join(bracket, "truth_tsf.json")))
    poses = tsfs["frames"][0]["poses"]
    whole = sum(p["weight"] for p in poses)
    x, y, roll = (sum(p["weight"] * p[k] for p in poses) / whole for k in ("t_x", "t_y", "theta_z_deg"))
    for p in (p for f in tsfs["frames"] for p in f["poses"]):
        p["theta_z_deg"] -= roll
        c, s = np.cos(np.deg2rad(p["theta_z_deg"])), np.sin(np.deg2rad(p["theta_z_deg"]))
        p["t_x"], p["t_y"] = p["t_x"] - (c * x - s * y), p["t_y"] - (s * x + c * y)
    with open(out, "w") as file:
        json.dump(tsfs, file)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--benchmark", required=True, help="folder of run.py")
    parser.add_argument("--scenes", help="folder of the scenes; default: as run.py")
    parser.add_argument("what", choices=["judge", "place"])
    parser.add_argument("bracket")
    parser.add_argument("files", nargs="+")
    a = parser.parse_args()
    if a.what == "place":
        return place(a.bracket, a.files[0])
    sys.path.insert(0, a.benchmark)
    import metrics
    import run
    import synth

    judge(a.bracket, a.files, a.scenes or os.path.join(a.benchmark, "..", "data", "scenes"), run, metrics, synth)


if __name__ == "__main__":
    main()
