"""The table and the pictures of what `run.py` has done.

    python report.py OUT [--strips strips.png]

It prints the table in Markdown. Shares of goals reached have 95 % Wilson intervals, means have bootstrapped ones.
"""

from __future__ import annotations

import argparse
import json
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

SHOWN = 8
"""Frames of a strip."""
ZOOM = 2
SOME = 2
"""Goals reached, and goals missed, that are shown of an arm."""


def interval(reached: int, goals: int) -> tuple[float, float]:
    """The 95 % Wilson interval of a share."""
    z, share = 1.96, reached / goals
    middle = (share + z**2 / (2 * goals)) / (1 + z**2 / goals)
    half = z * sqrt(share * (1 - share) / goals + z**2 / (4 * goals**2)) / (1 + z**2 / goals)
    return max(0.0, middle - half), min(1.0, middle + half)


def mean(values: list[float]) -> str:
    """A mean with its bootstrapped 95 % interval."""
    drawn = np.random.default_rng(0).choice(values, (2000, len(values))).mean(axis=1)
    low, high = np.percentile(drawn, [2.5, 97.5])
    return f"{np.mean(values):.3f} ({low:.3f}-{high:.3f})"


def row(arm: str, episodes: list[dict[str, Any]]) -> str:
    """One arm's line of the table."""
    reached = sum(each["reached"] for each in episodes)
    low, high = interval(reached, len(episodes))
    decisions = [decision for each in episodes for decision in each["decisions"]]
    seconds = [decision["seconds"] for decision in decisions if "seconds" in decision]
    steps = [sum(decision["steps"] for decision in each["decisions"]) for each in episodes]
    parts = [
        arm, str(len(episodes)), f"{reached / len(episodes):.0%} ({low:.0%}-{high:.0%})",
        mean([each["distance"] for each in episodes]), f"{np.mean([len(each['decisions']) for each in episodes]):.1f}",
        f"{np.median(seconds):.1f}" if seconds else "-", f"{np.mean(steps):.0f}",
    ]
    return "| " + " | ".join(parts) + " |"


def tracking(episodes: list[dict[str, Any]]) -> str:
    """How well the service followed the named object, in half sides of the picture."""
    seen = [decision for each in episodes for decision in each["decisions"] if "off" in decision]
    names = [len({d["id"] for d in each["decisions"] if d.get("id") is not None}) for each in episodes]
    found = np.mean([decision["found"] for decision in seen])
    off = np.median([decision["off"] for decision in seen])
    near = np.mean([decision["off"] < 0.1 for decision in seen])
    return (
        f"The service had the object in {found:.0%} of {len(seen)} decisions, under {np.mean(names):.1f} ids an episode; "
        f"the place it believed in was {off:.3f} half sides off in the median, less than 0.1 (4 cm) in {near:.0%}."
    )


def strip(folder: Path, number: int, title: str) -> np.ndarray:
    """Some frames of an episode with the target on them."""
    kept = np.load(folder / f"{number}.npz")
    frames = kept["frames"]
    frames = frames[np.linspace(0, len(frames) - 1, SHOWN).round().astype(int)]
    sheet = Image.new("RGB", (SHOWN * 64 * ZOOM, 64 * ZOOM + 14), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((2, 1), title, fill="black")
    x, y = ((at + 0.5) * ZOOM for at in kept["target"])
    for place, frame in enumerate(frames):
        left, size = place * 64 * ZOOM, (64 * ZOOM, 64 * ZOOM)
        sheet.paste(Image.fromarray(frame).resize(size, Image.Resampling.NEAREST), (left, 14))
        draw.ellipse((left + x - 4, 14 + y - 4, left + x + 4, 14 + y + 4), outline="white", width=1)
    return np.asarray(sheet)


def main(arguments: list[str] | None = None) -> None:
    """Prints the table; draws the strips."""
    parse = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parse.add_argument("out", type=Path)
    parse.add_argument("--strips", type=Path, help="picture of some goals reached and missed by each arm")
    parse.add_argument("--common", action="store_true", help="only goals that every arm has pursued")
    given = parse.parse_args(arguments)
    arms = {
        path.stem: [json.loads(line) for line in path.read_text().splitlines()] for path in sorted(given.out.glob("*.jsonl"))
    }
    if given.common:
        common = set.intersection(*({each["goal"] for each in episodes} for episodes in arms.values()))
        arms = {arm: [each for each in episodes if each["goal"] in common] for arm, episodes in arms.items()}
    print("| arm | goals | reached | final distance, m | decisions | s a decision | model steps an episode |")
    print("|---|---|---|---|---|---|---|")
    for arm, episodes in arms.items():
        print(row(arm, episodes))
    for arm, episodes in arms.items():
        if any("off" in decision for each in episodes for decision in each["decisions"]):
            print(f"\n{arm}: {tracking(episodes)}")
    if given.strips is None:
        return
    strips = []
    for arm, episodes in arms.items():
        for reached in (True, False):
            for each in [each for each in episodes if each["reached"] == reached][:SOME]:
                said = "reached" if reached else f"{each['distance'] * 100:.0f} cm away at the end"
                title = f"{arm}, goal {each['goal']}: {said} after {len(each['decisions'])} decisions"
                strips.append(strip(given.out / arm, each["goal"], title))
    Image.fromarray(np.concatenate(strips)).save(given.strips, optimize=True)


if __name__ == "__main__":
    main()
