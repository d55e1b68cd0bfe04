"""Run by test_ray.py in a network namespace of its own: two Ray nodes on this machine, and the map on them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

subprocess.run(["ip", "link", "set", "lo", "up"], check=True, timeout=10)

import ray  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402
from results import work  # noqa: E402
from results.work import names  # noqa: E402

from training.results.shards import map_shards  # noqa: E402
from training.results.table import write  # noqa: E402


def main(folder: Path) -> None:
    """Writes the rows of the map, and of a comparison of starts, on Ray and inline; a killed worker's shard must run again."""
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 80_000_000})
    cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    os.environ["RAY_ADDRESS"] = cluster.address
    try:
        shards = names([(k, 40) for k in range(12)])
        mapped = map_shards(work.squares, shards, on="ray")
        write(folder / "ray.parquet", mapped.rows)
        write(folder / "inline.parquet", map_shards(work.squares, shards, on="inline").rows)
        where = map_shards(work.process, names([(k, folder) for k in range(8)]), on="ray").rows
        dead = map_shards(work.dies_once, names([(k, folder) for k in range(4)]), on="ray", keep=folder / "shards").rows
        kept = sorted(path.name for path in (folder / "shards").iterdir())
        from training.compare.comparison import Shard, StartsConfig
        from training.compare.comparison import work as compare
        from training.compare.given import Given
        from training.compare.starts import Objective

        (folder / "rule.py").write_text(
            "from grasp_env.force import LinearCombination\n\ndef mine(grasp, wrench):\n    return LinearCombination()(grasp, wrench)\n"
        )
        given = Given.of((f"mine={folder / 'rule.py'}:mine",))
        (folder / "rule.py").unlink()  # another machine has no such file
        config = StartsConfig(wrenches=4)
        starts = {name: Shard(name, config, given, Objective()) for name in ("ball", "jump_10", "random_4")}
        for on in ("ray", "processes", "inline"):
            write(folder / f"starts-{on}.parquet", map_shards(compare, starts, on=on).rows)
        print(
            f"workers {mapped.workers}, processes {where['bytes'].nunique()}, dead {dead['problem'].tolist()}, kept {len(kept)}"
        )
    finally:
        ray.shutdown()
        cluster.shutdown()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
