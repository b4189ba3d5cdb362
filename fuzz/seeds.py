#!/usr/bin/env python3
"""Small files of every kind that is read, to begin from: fuzz/corpus/TARGET/*.  seeds.py [PROGRAM, default: unshaken]"""
import pathlib, shutil, struct, subprocess, sys, tempfile

program = shutil.which(sys.argv[1] if len(sys.argv) > 1 else "unshaken")
if program is None:
    sys.exit("name the program: fuzz/seeds.py target/debug/unshaken")
program = str(pathlib.Path(program).resolve())
corpus = pathlib.Path(__file__).resolve().parent / "corpus"


def dng():
    """A 16 x 12 Bayer frame, 16 bits, with all that a DNG needs, and a noise profile."""
    short = lambda *v: (3, len(v), struct.pack(f"<{len(v)}H", *v))
    long = lambda v: (4, 1, struct.pack("<I", v))
    raw = lambda *v: (1, len(v), bytes(v))
    text = lambda t: (2, len(t) + 1, t.encode() + b"\0")
    ratio = lambda kind, *v: (kind, len(v), b"".join(struct.pack("<ii", round(x * 10000), 10000) for x in v))
    pixels = struct.pack("<192H", *[512 + 70 * i for i in range(192)])
    exif = [(33434, ratio(5, 0.125)), (33437, ratio(5, 5.6)), (34855, short(200))]
    main = [
        (254, long(0)), (256, long(16)), (257, long(12)), (258, short(16)), (259, short(1)), (262, short(32803)), (271, text("Maker")),
        (272, text("Model 1")), (273, long(0)), (274, short(6)), (277, short(1)), (278, long(12)), (279, long(len(pixels))), (284, short(1)),
        (33421, short(2, 2)), (33422, raw(0, 1, 1, 2)), (34665, long(0)), (50706, raw(1, 4, 0, 0)), (50708, text("Maker Model 1")),
        (50714, short(512)), (50717, short(15360)), (50721, ratio(10, 3.24, -1.54, -0.5, -0.97, 1.88, 0.04, 0.06, -0.2, 1.06)),
        (50728, ratio(5, 0.5, 1, 0.625)), (50778, short(21)), (51041, (12, 2, struct.pack("<dd", 1e-4, 1e-6))),
    ]

    def directory(entries, at):
        table, more = struct.pack("<H", len(entries)), b""
        behind = at + 2 + 12 * len(entries) + 4
        for tag, (kind, count, content) in entries:
            if len(content) <= 4:
                place = content.ljust(4, b"\0")
            else:
                place = struct.pack("<I", behind + len(more))
                more += content + b"\0" * (len(content) % 2)
            table += struct.pack("<HHI", tag, kind, count) + place
        return table + struct.pack("<I", 0) + more

    exif_at = 8 + len(directory(main, 8))
    pixels_at = exif_at + len(directory(exif, exif_at))
    main = [(t, long({273: pixels_at, 34665: exif_at}[t]) if t in (273, 34665) else v) for t, v in main]
    return b"II*\0\x08\0\0\0" + directory(main, 8) + directory(exif, exif_at) + pixels


def keep(target, name, content):
    folder = corpus / target
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content)


with tempfile.TemporaryDirectory() as folder:
    at = pathlib.Path(folder)
    run = lambda *a: subprocess.run([program, *a], cwd=at, check=True, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL).stdout
    synth = ["synth", "--scene", "chart", "--size", "48x32", "--oversampling", "1", "--exposures", "1/30,1/8", "--median", "0.5"]
    run(*synth, "--shaken", "2", "--extent", "4", "--output-dir", "png")
    run(*synth, "--shaken", "none", "--jpeg", "90", "--output-dir", "jpeg")
    merge = ["merge", "--overwrite", "--no-align", "--sharp", "1,2", "--response", "srgb"]
    frames = ["png/frame1.png", "png/frame2.png"]
    for name, more in [("a.exr", ["--layers"]), ("h.exr", ["--half"]), ("a.tif", []), ("h.tif", ["--half"]), ("a.hdr", [])]:
        run(*merge, *more, "-o", name, "--preview", "p.jpg", "--gain-map", *frames)
    run("calibrate", "-o", "r.json", "jpeg/frame1.jpg", "jpeg/frame2.jpg")
    (at / "brackets.toml").write_text(run("batch", "png", "jpeg", "--output-dir", "out", "--dry-run"))
    (at / "config.toml").write_text(run("merge", "--print-config", "--config", "none", "--preset", "archive", "--patch", "3,4"))
    (at / "a.dng").write_bytes(dng())
    kinds = {
        "exr": ["a.exr", "h.exr"], "radiance": ["a.hdr"], "raw": ["a.dng"], "response": ["r.json"], "tsf": ["png/truth_tsf.json"],
        "picture": ["png/frame1.png", "jpeg/frame1.jpg", "p.jpg", "a.tif", "h.tif"], "toml": ["brackets.toml", "config.toml"],
        "exif": ["png/frame1.png", "jpeg/frame1.jpg", "p.jpg", "a.tif", "a.dng"],
    }
    for target, names in kinds.items():
        for name in names:
            keep(target, name.replace("/", "-"), (at / name).read_bytes())
    jpeg = (at / "p.jpg").read_bytes()
    place = jpeg.index(b"ICC_PROFILE\0")
    length = struct.unpack(">H", jpeg[place - 2 : place])[0]
    keep("icc", "srgb.icc", jpeg[place + 14 : place - 2 + length])
