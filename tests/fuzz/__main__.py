"""``python -m tests.fuzz [--cases N] [--seed S] [--kinds A,B]``: mutants of every kind of file, judged one by one.

``python -m tests.fuzz --in-process``: many mutants in one process, a tenth of the time for each; their rankings are not
compared.

``python -m tests.fuzz --kills N``: runs that are killed at random moments, and run again.

Every verdict is a line of ``results.jsonl`` in the folder ``--keep``; mutants that fare badly lie beside it. A fuzzer
that was interrupted goes on where it was when it is called again with the same folder. Ends with 1 where anything fared
badly.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from tests.fuzz import cases, in_process, kills
from tests.fuzz.cases import Bench, Verdict
from tests.fuzz.kinds import KINDS, Kind
from tests.fuzz.mutating import mutant

_RESULTS = "results.jsonl"
Results = Counter[tuple[str, str]]


def fuzz(kinds: list[str], number: int, seed: int, keep: Path, in_one: bool = False) -> Results:
    """``number`` mutants, shared out evenly; how many of each kind got each verdict."""
    keep.mkdir(parents=True, exist_ok=True)
    done = _done(keep / _RESULTS, seed)
    counts: Results = Counter((kind, verdict) for (kind, _), verdict in done.items())
    with tempfile.TemporaryDirectory(prefix="egvs-fuzz-") as temporary, (keep / _RESULTS).open("a") as results:
        cases.warm_up(Path(temporary))
        for index, kind in enumerate(kinds):
            share = range(number // len(kinds) + (index < number % len(kinds)))
            if not (left := [case for case in share if (kind, case) not in done]):
                continue
            folder = Path(temporary) / f"kind{index}"
            judge = in_process.judge_all if in_one and not KINDS[kind].store else _judge_all
            for case, verdict in judge(KINDS[kind], folder, seed, left):
                if verdict.name not in (*cases.WELL, *in_process.WELL):
                    _keep_bad(KINDS[kind], folder, seed, case, verdict, keep)
                counts[kind, verdict.name] += 1
                line = {"seed": seed, "kind": kind, "case": case, "verdict": verdict.name, "told": verdict.told,
                        "busy_s": round(verdict.busy_s, 2), "peak_mb": round(verdict.peak_bytes / 1e6)}  # fmt: skip
                results.write(json.dumps(line) + "\n")
                results.flush()
            print(f"{kind}: {_told(counts, kind)}", flush=True)
    return counts


def _done(path: Path, seed: int) -> dict[tuple[str, int], str]:
    """The verdicts of an earlier call."""
    if not path.is_file():
        return {}
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    return {(line["kind"], line["case"]): line["verdict"] for line in lines if line["seed"] == seed}


def _judge_all(kind: Kind, folder: Path, seed: int, numbers: list[int]) -> Iterator[tuple[int, Verdict]]:
    """Yield the verdict of each mutant, read by a process of its own."""
    bench = Bench(kind, folder)
    for case in numbers:
        rng = random.Random(f"{seed}/{kind.name}/{case}")
        file = rng.choice(bench.files)
        yield case, bench.judge(file, mutant(rng, file.read_bytes()))


def _keep_bad(kind: Kind, folder: Path, seed: int, case: int, verdict: Verdict, keep: Path) -> None:
    """Write a mutant that fared badly beside the results."""
    rng = random.Random(f"{seed}/{kind.name}/{case}")
    file = rng.choice(sorted((folder / "base").glob(kind.file)))
    path = keep / f"{kind.name.replace(' ', '_').replace('/', '_')}-{seed}-{case}-{file.name}"
    path.write_bytes(mutant(rng, file.read_bytes()))
    print(f"  {verdict.name}: {path}: {verdict.told}", flush=True)


def _worst(path: Path, seed: int) -> str:
    """The case that worked longest, and the one with the largest memory."""
    lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    lines = [line for line in lines if line["seed"] == seed and "busy_s" in line]
    worst = {key: max(lines, key=lambda line: float(line[key])) for key in ("busy_s", "peak_mb") if lines}
    return "; ".join(f"most {key}: {line[key]} ({line['kind']}, case {line['case']})" for key, line in worst.items())


def _told(counts: Results, kind: str) -> str:
    return ", ".join(f"{count} {verdict}" for (name, verdict), count in sorted(counts.items()) if name == kind)


def kill(number: int, seed: int) -> int:
    """How ``number`` kills ended; 1 where one ended badly."""
    with tempfile.TemporaryDirectory(prefix="egvs-fuzz-") as temporary:
        cases.warm_up(Path(temporary))
        counts = kills.kill(number, seed, Path(temporary) / "kills")
    print(f"{number} kills: " + ", ".join(f"{count} {verdict}" for verdict, count in counts.most_common()), flush=True)
    return int(set(counts) != {kills.SAME})


def main() -> int:
    """Parse, fuzz, print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__.split(":")[0])
    parser.add_argument("--cases", type=int, default=1000, help="mutants, shared out evenly among the kinds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", default="", help=f"some of: {', '.join(KINDS)}; all by default")
    parser.add_argument("--keep", type=Path, default=Path("build/fuzz"), help="folder of results and of bad mutants")
    parser.add_argument("--in-process", action="store_true", help="many mutants in one process; rankings do not count")
    parser.add_argument("--kills", type=int, default=0, help="instead: runs that are killed, and run again")
    given = parser.parse_args()
    if given.kills:
        return kill(given.kills, given.seed)
    kinds = [name.strip() for name in given.kinds.split(",") if name.strip()] or list(KINDS)
    if unknown := [name for name in kinds if name not in KINDS]:
        parser.error(f"unknown kinds {', '.join(unknown)}; some of: {', '.join(KINDS)}")
    counts = fuzz(kinds, given.cases, given.seed, given.keep, given.in_process)
    verdicts = Counter[str]()
    for (_, verdict), count in counts.items():
        verdicts[verdict] += count
    print(
        f"{sum(verdicts.values())} mutants of {len(kinds)} kinds: "
        + ", ".join(f"{n} {v}" for v, n in verdicts.most_common())
    )
    print(_worst(given.keep / _RESULTS, given.seed))
    return int(any(verdict not in (*cases.WELL, *in_process.WELL) for verdict in verdicts))


if __name__ == "__main__":
    sys.exit(main())
