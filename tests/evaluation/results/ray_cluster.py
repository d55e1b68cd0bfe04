"""The map on two Ray nodes in a network namespace, for test_shards.py."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from evaluation.results import work
from evaluation.results.work import names

from training.evaluation.results.shards import map_shards
from training.evaluation.results.table import write


def main(folder: Path) -> None:
    """Write the rows of the map on Ray and inline; the shard of a killed worker must run again."""
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True, timeout=10)
    import ray
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 80_000_000}
    )
    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    os.environ["RAY_ADDRESS"] = cluster.address
    try:
        shards = names([(k, 40) for k in range(12)])
        rows, about = map_shards(work.squares, shards, on="ray")
        write(folder / "ray.csv", rows)
        write(folder / "inline.csv", map_shards(work.squares, shards, on="inline")[0])
        where = map_shards(work.process, names([(k, folder) for k in range(8)]), on="ray")[0][
            "bytes"
        ].nunique()
        dead = map_shards(work.dies_once, names([(k, folder) for k in range(4)]), on="ray")[0][
            "problem"
        ].tolist()
        print(f"workers {about['workers']}, processes {where}, dead {dead}")
    finally:
        ray.shutdown()
        cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
