#!/usr/bin/env python3
"""What Blender and darktable make of the program's OpenEXR files: docs/PHOTOGRAPHY.md, "Colours in other programs".

    python3 docs/colours.py unshaken FOLDER

Needs numpy and tifffile, and the commands blender and darktable-cli. Writes a chart as two floating-point frames, merges them with each of the
primaries and prints the largest error of each patch's centre, relative to the patch's largest channel, in per cent.
"""
import os, subprocess, sys

PRIMARIES = ["rec709", "rec2020", "p3", "acescg"]
SIZE, COLUMNS = 48, 6
# Or BLENDER=python3, where that has the package bpy.
BLENDER = os.environ.get("BLENDER", "blender -b --factory-startup -P").split()


def blender(path):
    """Inside Blender: the pixels of the image as Blender loads it, top row first, and the colour space that it takes them for."""
    import bpy
    import numpy as np

    image = bpy.data.images.load(path)
    pixels = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], image.channels)
    np.save(path + ".blender.npy", pixels[::-1, :, :3])
    with open(path + ".space", "w") as note:
        note.write(f"Blender {bpy.app.version_string}, {image.colorspace_settings.name}")


if "--" in sys.argv:
    blender(sys.argv[-1])
    sys.exit()

import numpy as np
import tifffile


def patches():
    """24 colours in linear Rec. 709: greys over eight stops, the primaries, and muted ones."""
    greys = [[2.0**e] * 3 for e in (2, 1, 0, -1, -2, -5)]
    primaries = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 3, 3], [3, 0, 3], [3, 3, 0]]
    muted = np.random.default_rng(1).uniform(0.02, 0.9, (12, 3)).tolist()
    return np.array(greys + primaries + muted)


def matrix(x):
    """Linear RGB of these primaries and this white to XYZ (SMPTE RP 177)."""
    xyz = np.array([[a / b, 1, (1 - a - b) / b] for a, b in x]).T
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])


def expected(colours, name):
    """The chart in these primaries; between white points by the Bradford transform."""
    d65 = [0.3127, 0.3290]
    known = {
        "rec709": [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06], d65],
        "rec2020": [[0.708, 0.292], [0.170, 0.797], [0.131, 0.046], d65],
        "p3": [[0.680, 0.320], [0.265, 0.690], [0.150, 0.060], d65],
        "acescg": [[0.713, 0.293], [0.165, 0.830], [0.128, 0.044], [0.32168, 0.33767]],
    }
    cones = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    one, other = matrix(known["rec709"]), matrix(known[name])
    gain = (cones @ other.sum(1)) / (cones @ one.sum(1))
    adapt = np.linalg.solve(cones, gain[:, None] * cones)
    return colours @ (np.linalg.solve(other, adapt @ one)).T


def centres(image):
    rows = image.shape[0] // SIZE
    return np.array([image[SIZE * (i // COLUMNS) + SIZE // 2, SIZE * (i % COLUMNS) + SIZE // 2, :3] for i in range(rows * COLUMNS)])


def error(image, wanted):
    return 100 * np.max(np.abs(centres(image) - wanted) / wanted.max(1, keepdims=True))


def run(*command, **more):
    done = subprocess.run(command, capture_output=True, text=True, **more)
    if done.returncode:
        sys.exit(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout


def main(program, folder):
    os.makedirs(folder, exist_ok=True)
    colours = patches()
    chart = np.kron(colours.reshape(-1, COLUMNS, 3), np.ones((SIZE, SIZE, 1)))
    at = lambda name: os.path.join(folder, name)
    # Frames of 1/8 and 1 s; the reference is the longer one, in which the chart's 1 is white.
    for name, time in (("short.tif", 0.125), ("long.tif", 1.0)):
        tifffile.imwrite(at(name), np.minimum(chart * time, 1).astype(np.float32), photometric="rgb")
    for name in PRIMARIES:
        for ending in [".exr", ".tif"] + [".hdr"] * (name == "rec709"):
            result = at(name + ending)
            common = ["--exposures", "1/8,1", "--no-align", "--sharp", "1,2", "--reference", "2", "--overwrite", "--quiet"]
            run(program, "merge", *common, "--primaries", name, "-o", result, at("short.tif"), at("long.tif"))
            run(*BLENDER, os.path.abspath(__file__), "--", os.path.abspath(result))
            with open(result + ".space") as note:
                report(result, note.read(), np.load(result + ".blender.npy"), colours, name)
            shown = at(name + ending + "-darktable.tif")
            if os.path.exists(shown):
                os.remove(shown)
            tiff = "plugins/imageio/format/tiff/"
            settings = ["plugins/darkroom/workflow=none", tiff + "bpp=32", tiff + "compress=0"]
            options = ["--disable-opencl", "--configdir", at("darktable"), "--library", ":memory:"]
            options += [word for setting in settings for word in ("--conf", setting)]
            run("darktable-cli", result, shown, "--icc-type", "LIN_REC709", "--apply-custom-presets", "false", "--core", *options)
            report(result, "darktable", tifffile.imread(shown), colours, name)


def report(result, program, image, colours, name):
    own, rec709 = error(image, expected(colours, name)), error(image, colours)
    print(f"{os.path.basename(result):12} {program:32} {own:7.3f} from the file's numbers {rec709:7.3f} from Rec. 709", flush=True)


main(*sys.argv[1:])
