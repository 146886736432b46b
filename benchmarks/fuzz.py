"""Throw damaged files at the readers: each has to give a value or one `InputError`, never anything else.

    python -m benchmarks.fuzz --executions 1000000 --seed 1
    python -m benchmarks.fuzz --formats .png .exr .jpg .tif .hdr --executions 200000

Small sound files of every format are mutated (bytes, tokens, lines, whole values) and read from a file, as a user's
would be. What raises anything but `brdf.InputError`, or an error of several lines, is printed with what did it.
"""

import argparse
import random
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

from benchmarks.fuzz_corpus import corpus
from brdf.errors import InputError

TOKENS = [
    *(
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e999",
        "1e308",
        "-0.0",
        "1e-320",
        "9" * 400,
        "0x10",
        "1_000",
        "٣",
        "true",
        "null",
    ),
    *(
        '""',
        "[]",
        "{}",
        "[[]]",
        "[1, [2]]",
        '"a"',
        "[true]",
        "2026-01-01",
        "0" * 50,
        "\0",
        "é",
        "\u2028",
        "'",
        '"',
        "=",
        "#",
    ),
    *(
        "[camera]",
        "[[lights]]",
        "[lights]",
        "newmtl",
        "Kd",
        "illum -1",
        "Ns",
        "#DIM 6 1",
        "#PARAM_IN CARTESIAN",
        "#VS 2",
    ),
    *("#PARAM_IN COS_TH_TD", "type", "fitted", "mesh", "k_d", '"phong"', "normalized-phong", "..", "/etc/passwd", "\\"),
]


def mutated(content: bytes, dice: random.Random) -> bytes:
    """The content with one to four injuries.

    Args:
        content: sound.
        dice: source of chance.
    """
    for _ in range(dice.choice([1, 1, 1, 2, 2, 4])):
        at, end = (dice.randrange(len(content) + 1) for _ in range(2))
        match dice.randrange(8):
            case 0:
                content = content[:at] + bytes([dice.randrange(256)]) + content[at + 1 :]
            case 1:
                content = content[: min(at, end)] + content[min(max(at, end), min(at, end) + 40) :]
            case 2:
                content = content[:at] + content[min(at, end) : min(at, end) + 60] + content[at:]
            case 3:
                content = content[:at]
            case 4 | 5:
                words = content.replace(b",", b" , ").replace(b"]", b" ]").split(b" ")
                words[dice.randrange(len(words))] = dice.choice(TOKENS).encode()
                content = b" ".join(words)
            case 6:
                lines = content.split(b"\n")
                one, other = dice.randrange(len(lines)), dice.randrange(len(lines))
                lines[one], lines[other] = lines[other], lines[one] if dice.random() < 0.5 else b""
                content = b"\n".join(lines)
            case _:
                content = content[:at] + dice.choice(TOKENS).encode() + content[at:]
    return content


def run(
    executions: int, seed: int, seconds: float, folder: Path, formats: list[str] | None = None
) -> tuple[Counter[str], list[str]]:
    """Fuzz; returns how often each format gave a value or an error, and what went wrong.

    Args:
        executions: how many files to read.
        seed: of the chance.
        seconds: when to stop at the latest.
        folder: where to write them.
        formats: suffixes to try; None for all.
    """
    dice = random.Random(seed)
    sound = [one for one in corpus(folder) if formats is None or one[0] in formats]
    outcomes: Counter[str] = Counter()
    found: dict[str, str] = {}
    stop = time.monotonic() + seconds
    for count in range(executions):
        suffix, content, reader = sound[count % len(sound)]
        path = folder / f"file{suffix}"
        content = mutated(content, dice)
        path.write_bytes(content)
        try:
            reader(path)
            outcomes[f"{suffix} value"] += 1
        except InputError as error:
            outcomes[f"{suffix} error"] += 1
            if "\n" in str(error) or str(folder) not in str(error):
                found.setdefault(f"{suffix} words", f"{error!r} of {content!r}")
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            found.setdefault(f"{type(error).__name__} {place.filename}:{place.lineno}", f"{error} of {content!r}")
        if count % 256 == 0 and time.monotonic() > stop:
            break
    return outcomes, [f"{kind}: {what}" for kind, what in found.items()]


def main() -> None:
    """Run and report."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--executions", type=int, default=1_000_000)
    parser.add_argument("--seconds", type=float, default=3600.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--formats", nargs="*", help="suffixes; default all")
    arguments = parser.parse_args()
    start = time.monotonic()
    # Memory instead of a disk where the system has it: the files live for a millisecond.
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        outcomes, found = run(arguments.executions, arguments.seed, arguments.seconds, Path(folder), arguments.formats)
    for outcome, count in sorted(outcomes.items()):
        print(f"{outcome:<16}{count:>10}")
    print(f"{sum(outcomes.values())} executions in {time.monotonic() - start:.0f} s, {len(found)} kinds of findings")
    for line in found:
        print(line)


if __name__ == "__main__":
    main()
