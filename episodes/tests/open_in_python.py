"""Opens an episode file in pandas, Polars and DuckDB and checks that all three see the same episodes.

Needs: pandas pyarrow polars duckdb. Run: python episodes/tests/open_in_python.py [FILE.parquet]
"""

import json
import pathlib
import sys

import duckdb
import numpy as np
import pandas as pd
import polars as pl
import pyarrow.parquet as pq

SAMPLE = pathlib.Path(__file__).parent.parent / "samples" / "push1-heldout.parquet"
path = sys.argv[1] if len(sys.argv) > 1 else str(SAMPLE)

metadata = pq.read_metadata(path).metadata
assert metadata[b"gatsbi.format"] == b"gatsbi.episodes", metadata
assert metadata[b"gatsbi.format_version"] == b"1", metadata
info = json.loads(metadata[b"gatsbi.dataset"])
height, width, channels = info["height"], info["width"], info["channels"]
dimensions = len(info["actions"])


def check(rows, reader):
    """rows: dictionaries with the cells as this reader returns them. Returns what must be equal between readers."""
    seen = []
    for row in rows:
        length = row["length"]
        frames = np.frombuffer(row["rgb"], np.uint8).reshape(length, height, width, channels)
        mask = np.frombuffer(row["mask"], np.uint8).reshape(length, height, width)
        actions = np.asarray(row["actions"], np.float32).reshape(length, dimensions)
        objects = np.asarray(row["object_positions"], np.float32).reshape(length, row["object_count"], 3)
        assert np.isfinite(actions).all() and mask.max() < 2 + row["object_count"]
        seen.append((row["episode_id"], frames.tobytes(), mask.tobytes(), actions.tobytes(), objects.tobytes()))
    print(f"{reader}: {len(seen)} episodes, ids {seen[0][0]} to {seen[-1][0]}")
    return seen


in_pandas = check(pd.read_parquet(path).to_dict("records"), "pandas")
in_polars = check(pl.read_parquet(path).to_dicts(), "polars")
in_duckdb = check(duckdb.sql(f"from '{path}'").to_arrow_table().to_pylist(), "duckdb")
assert in_pandas == in_polars == in_duckdb
assert len(in_pandas) == pq.read_metadata(path).num_rows > 0

# A question that needs no pixels decodes none.
answer = duckdb.sql(f"select max(length), count(*) from '{path}' where object_count >= 1").fetchall()
lengths = pl.read_parquet(path, columns=["length"])["length"]
assert answer == [(lengths.max(), len(lengths))], answer
