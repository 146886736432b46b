"""Time this project and its peers on the same arrays.

    python -m benchmarks.peers                          # writes benchmarks/peers.json and peers.png
    python -m benchmarks.peers --sizes 64 512 --only SciPy engine
    python -m benchmarks.peers --from-json              # table and plot of what was timed before

Ten unknowns, three channels, one directional light, Blinn-Phong with n = 80 and noise of 1 %, the arrays of
`benchmarks.engine`, in memory and on the device before the clock starts. Errors are relative to the optimum of the sum
of squares. Peers start at n = 10 with the best k of that exponent, for which they are not charged; this project gets no
start and searches n from 0.1 to 1e6. All may use all cores, and where one core is faster that time counts. What is
compiled is compiled before. The unit is the pass of `benchmarks.engine`, timed before and after each run; medians. A
peer that is not installed is named and left out.

Each iterate is noted when the peer evaluates it: the time to an accuracy is that of the first within it, be it a trial
that was not accepted. How each peer ended is in the JSON.
"""

import argparse
import json
import os
import platform
from pathlib import Path

from benchmarks.peers.catalogue import PEERS
from benchmarks.peers.measure import grow
from benchmarks.peers.report import MEASURES, Row, duration, plot, ratios, remarks, table

FOLDER = Path(__file__).parents[1]


def main() -> None:
    """Time, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256, 512, 1024, 2048, 4096])
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for one run; a peer grows no further beyond")
    parser.add_argument("--only", nargs="+", help="peers whose names begin so; the others' rows are kept")
    parser.add_argument("--keep", action="store_true", help="keep the rows of other sizes")
    parser.add_argument("--out", type=Path, default=FOLDER / "peers", help="of the .json and .png")
    parser.add_argument("--from-json", action="store_true", help="time nothing")
    given = parser.parse_args()
    store = given.out.with_suffix(".json")
    chosen = [] if given.from_json else [n for n in PEERS if not given.only or n.startswith(tuple(given.only))]
    rows: list[Row] = []
    if store.exists() and (given.from_json or given.only or given.keep):
        rows = [
            row
            for row in json.loads(store.read_text())["rows"]
            if row["peer"] not in chosen or ("size" in row and row["size"] not in given.sizes)
        ]
    for name in chosen:
        for row in grow(PEERS[name], given.sizes, given.limit, rows):
            rows.append(row)
            told = row.get("missing") or row.get("stopped") or f"{duration(row['seconds'])}, {row['says']}"
            print(f"  {name} {row.get('size', '')}: {told}", flush=True)
            machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
            store.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    sizes = sorted({row["size"] for row in rows if "size" in row})
    for measure in MEASURES:
        print("\n" + table(rows, measure, sizes))
    print("\n" + remarks(rows))
    print("\n".join(ratios(rows, size) for size in sizes if size >= 512 or size == sizes[-1]))
    plot(rows, given.out.with_suffix(".png"))


if __name__ == "__main__":
    main()
