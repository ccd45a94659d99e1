"""Run by an interpreter with faster-coco-eval: ANNOTATIONS OUT evaluates truth against itself."""

# The devkits are in another environment.
# pyright: reportMissingImports=false, reportMissingParameterType=false

import json
import sys
from pathlib import Path

from faster_coco_eval import COCO, COCOeval_faster


def main(annotations: str, out: str) -> None:
    truth = COCO(annotations)
    rows = [{**a, "score": 1.0} for a in truth.dataset["annotations"]]
    found = truth.loadRes(rows)
    ap = {}
    for kind in ("bbox", "segm"):
        evaluation = COCOeval_faster(truth, found, kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
        ap[kind] = float(evaluation.stats[0])
    masks = {a["id"]: int(truth.annToMask(a).sum()) for a in truth.dataset["annotations"]}
    Path(out).write_text(json.dumps({"ap": ap, "masks": masks}))


if __name__ == "__main__":
    main(*sys.argv[1:])
