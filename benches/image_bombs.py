"""Peak memory of the program on image bombs: files of less than a megabyte that decode to as many pixels as it reads, and to more.

    python benches/image_bombs.py [SIXFOLD]

SIXFOLD is the program (default: target/release/sixfold). Each file goes in the place of the one image of its kind that `sixfold
estimate` reads; the camera is for another size, so that nothing happens behind the reading. Needs Linux, and no package.
"""

import os
import pathlib
import subprocess
import sys
import tempfile
import time
import zlib

ROOT = pathlib.Path(__file__).resolve().parent.parent
# Colour types of PNG with their channels.
GREY, RGB, RGBA = (0, 1), (2, 3), (6, 4)


def chunk(kind, data):
    checksum = zlib.crc32(kind + data)
    return len(data).to_bytes(4, "big") + kind + data + checksum.to_bytes(4, "big")


def image(path, width, height, colour, bits, value=0):
    """A PNG file whose pixels all have one value, in each of their bytes."""
    kind, channels = colour
    row = bytes([0]) + bytes([value]) * ((width * channels * bits + 7) // 8)
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([bits, kind, 0, 0, 0])
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b""))


def measured(command, folder):
    """Exit status, the last line of standard error, peak megabytes and seconds of a command."""
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    message = process.stderr.read().strip().splitlines()
    process.stderr.close()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = status >> 8
    seconds = time.perf_counter() - start
    # Linux counts in units of 1024 bytes.
    return process.returncode, message[-1] if message else "", usage.ru_maxrss * 1024 / 1e6, seconds


def main():
    program = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "target/release/sixfold").resolve()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "camera.json").write_text(
            '{"fx": 300, "fy": 300, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48, "depth_scale": 1}'
        )
        (folder / "part.xyz").write_text("0 0 0\n1 0 0\n0 1 0\n0 0 1\n")
        image(folder / "depth.png", 64, 48, GREY, 16, value=2)
        beside = "--camera camera.json --object part.xyz --unit cm"
        uses = {
            "depth": f"estimate --depth bomb.png {beside}",
            "colour": f"estimate --depth depth.png --rgb bomb.png {beside}",
            "mask": f"estimate --depth depth.png --mask bomb.png {beside}",
        }
        print(f"{'read as':8} {'PNG':14} {'megapixels':>10} {'file (kB)':>9} {'peak (MB)':>9} {'seconds':>7}  message")
        _, message, peak, seconds = measured([program, "--version"], folder)
        print(f"{'-':8} {'-':14} {'-':>10} {'-':>9} {peak:9.0f} {seconds:7.2f}  (the program alone)")
        for use, text, size, colour, bits in [
            ("depth", "grey, 16 bits", 10_000, GREY, 16),
            ("colour", "RGB, 8 bits", 10_000, RGB, 8),
            ("colour", "RGBA, 8 bits", 10_000, RGBA, 8),
            ("colour", "RGBA, 16 bits", 10_000, RGBA, 16),
            ("mask", "grey, 1 bit", 10_000, GREY, 1),
            ("mask", "RGBA, 16 bits", 10_000, RGBA, 16),
            ("depth", "grey, 16 bits", 10_001, GREY, 16),
            ("mask", "grey, 1 bit", 32_000, GREY, 1),
        ]:
            image(folder / "bomb.png", size, size, colour, bits)
            kilobytes = (folder / "bomb.png").stat().st_size / 1000
            status, message, peak, seconds = measured([program, *uses[use].split()], folder)
            assert status == 2, (status, message)
            print(f"{use:8} {text:14} {size * size / 1e6:10.1f} {kilobytes:9.0f} {peak:9.0f} {seconds:7.2f}  {message[:90]}")


if __name__ == "__main__":
    main()
