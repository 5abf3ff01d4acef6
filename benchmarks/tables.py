"""Write the tables of the documentation from the rows in benchmarks/results.

    python -m benchmarks tables

Each table is between `<!-- benchmarks NAME -->` and `<!-- end -->`. Below it are the processor, the commit and the load
of the measurement. `python -m benchmarks all` also writes the tables.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable
from pathlib import Path

from benchmarks.parts.view_tables import NAMES, Result, views, views_over, views_residuals, views_summary, views_tuned
from hyperplanes.utilities.files.reading import DataError
from hyperplanes.utilities.files.tables import markdown_table
from hyperplanes.utilities.files.writing import write_whole

__all__ = ["TABLES", "fill", "main"]

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
MARKED = re.compile(r"(<!-- benchmarks (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def main(arguments: list[str]) -> int:
    """Write the tables of all pages."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks tables", description=__doc__)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder with the rows (default: %(default)s)")
    chosen = parser.parse_args(arguments)
    for page in PAGES:
        before = page.read_text(encoding="utf-8")
        if (after := fill(before, chosen.results, page)) != before:
            write_whole(page, after.encode())
            print(f"benchmarks tables: wrote {page.relative_to(ROOT)}")
    return 0


def fill(text: str, results: Path = RESULTS, page: Path | str = "page") -> str:
    """Fill the tables of a page from results.

    A table that no benchmark makes, or whose rows are missing, is a DataError.

    Args:
        text: the text of the page.
        results: folder with the results, NAME.json.
        page: name of the page, for messages.

    Returns:
        The text with the new tables.
    """

    def replaced(found: re.Match[str]) -> str:
        name = found[2]
        if name not in TABLES:
            raise DataError(f"{page}: expected a table of {', '.join(TABLES)}, found {name}; correct its marker")
        made = {each: _read(results / f"{each}.json", page) for each in SOURCES.get(name, (name,))}
        origins: dict[str, list[str]] = {}  # by description of the measurement, the files that have it
        for source, result in made.items():
            origins.setdefault(_measured(result), []).append(f"{source}.json")
        whose = [origin + f" ({', '.join(files)})" * (len(origins) > 1) for origin, files in origins.items()]
        measured = "; ".join(whose)
        return f"{found[1]}{TABLES[name](*made.values()).rstrip()}\n\n*{measured}.*\n{found[3]}"

    return MARKED.sub(replaced, text)


def _read(path: Path, page: Path | str) -> Result:
    if not path.is_file():
        raise DataError(f"{path}: expected the rows of {page}, found nothing; run python -m benchmarks {path.stem}")
    return json.loads(path.read_text(encoding="utf-8"))


def _measured(result: Result) -> str:
    """How the rows were measured: commits for rows of quality; also the machine and its load for rows of speed."""
    if result["benchmark"] in OF_QUALITY:
        commits = dict.fromkeys([result["commit"], *(row["commit"] for row in result["rows"] if "commit" in row)])
        return f"Commit {', '.join(commits)}"
    load = result.get("load")
    if result.get("device") == "cuda":
        return f"{result['gpu']}, PyTorch {result['torch']}; commit {result['commit']}"
    threads, beside = result["threads"], "not recorded" if load is None else f"{load:.2f} cores"
    machine = f"{result['processor']}, {result['cores']} cores, {threads} thread{'s' if threads > 1 else ''}"
    return f"{machine}; commit {result.get('commit') or 'not recorded'}; load of other processes: {beside}"


def _seconds(value: float) -> str:
    if value < 0.1:
        return f"{1000 * value:.0f} ms"
    return f"{value:.{0 if value >= 10 else 1 if value >= 2 else 2}f} s"


def _adapting(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        lines.append([row["name"].split(", ", 2)[2], _seconds(row["seconds"]), f"{row['psnr']:.2f} dB"])
    return markdown_table(["from files to something that renders", "seconds", "PSNR"], lines)


def _baked(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        quality = [f"{row[name]:.2f} dB" for name in ("field", "baked", "fitted")]
        times = [_seconds(row[name] / 1000) for name in ("field_ms", "voxels_ms")]
        size = f", {row['size']}" if "size" in row else ""
        name = f"{NAMES[row['name']]} ({row['objects']}){size}, {row['views']} views"
        lines.append([name, *quality, *times, _seconds(row["bake_seconds"] + row["fit_seconds"])])
    headings = ["field, one forward pass", "voxels as baked", "fitted", "a view by the field", "by voxels", "made in"]
    return markdown_table(["", *headings], lines)


def _busy(result: Result) -> str:
    rows = [row for row in result["rows"] if row["policy"] == "passive"]
    found = {(row["name"], row["load"], row["threads"]): row for row in rows}
    lines = []
    for name in dict.fromkeys(row["name"] for row in rows):
        one = _seconds(found[name, "idle", 1]["seconds"])
        ratios = [f"{found[name, load, 2]['speedup']:.2f}" for load in ("idle", "busy")]
        lines.append([f"{name.replace('_', '-')} ({one} by one thread)", *ratios])
    return markdown_table(["two threads over one", "alone", "beside two busy processes"], lines)


def _generation(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        if row["name"].startswith("generate, "):
            rates = [f"{row[name]:.0f}" for name in ("reference_images_per_second", "images_per_second")]
            over = f"{row['speedup']:.1f} ({row['speedup_low']:.1f} to {row['speedup_high']:.1f})"
            lines.append([row["name"].removeprefix("generate, "), *rates, over, f"{row['processor_speedup']:.1f}"])
    return markdown_table(["", "loop, images/s", "ours, images/s", "ratio", "in processor time"], lines)


def _lookup(result: Result) -> str:
    rows = [row for row in result["rows"] if (row["planes"], row["points"], row["resolution"]) == (25, 65536, 200)]
    lines = []
    for part, gradient in dict.fromkeys((row["part"], row["gradient"]) for row in rows):
        ways: Result = {}
        for row in rows:  # the first row of each; later ones belong to the sweeps
            if (row["part"], row["gradient"]) == (part, gradient):
                ways.setdefault(row["way"], row)
        ours = next(ways[way] for way in ("cpu_packed", "cpu", "triton", "torch") if way in ways)
        per_second = "million_lookups_per_second"
        over = f"{ours['speedup']:.1f} ({ours['speedup_low']:.1f} to {ours['speedup_high']:.1f})"
        others = [f"{ways[way][per_second]:.0f}" for way in ("kornia_loop", "kornia_batched")]
        name = f"{part}, with gradient" if gradient else part
        lines.append([name, *others, f"**{ours[per_second]:.0f}**", over, f"{ours['over_batched']:.1f}"])
    headings = ["Kornia, camera by camera", "Kornia batched", "ours", "over the loop", "over batched"]
    return markdown_table(["million lookups/s", *headings], lines)


def _gpu(result: Result) -> str:
    found = {row["name"]: row for row in result["rows"] if "milliseconds" in row}
    lines = []
    for network, name in NETWORKS.items():
        for size in dict.fromkeys(each.split(", ")[1] for each in found if each.startswith(f"{network}, ")):
            default, one, paper = (found.get(f"{network}, {size}, {way}") for way in WAYS_TO_DRAW)
            times = [f"{way['milliseconds']:.0f} ms" if way else "-" for way in (default, one, paper)]
            ratio = f"{paper['milliseconds'] / one['milliseconds']:.1f}" if one and paper else "-"
            quality = " / ".join(f"{way['psnr']:.2f}" if way else "-" for way in (default, one, paper))
            memory = f"{default['peak_gib']:.1f} GiB" if default else "-"
            lines.append([f"{name}, {size}", *times, ratio, quality, memory])
    return markdown_table(["one view", *WAYS_TO_DRAW, "ratio", "PSNR in dB", "memory"], lines)


def _gpu_ways(result: Result) -> str:
    found: dict[str, dict[str, Result]] = {}
    for row in result["rows"]:
        network, size, way = row["name"].split(", ", 2) if row["name"].count(", ") == 2 else ("", "", "")
        if size == "200x200" and way not in ("default", "paper's protocol") and "error" not in row:
            found.setdefault(way, {}).setdefault(network, row)
    lines = []
    for way, networks in found.items():
        ones = [networks.get(network) for network in NETWORKS]
        cells = [f"{one['milliseconds']:.1f} ms, {one['psnr']:.2f} dB" if one else "-" for one in ones]
        lines.append(["as it is" if way == "one ray a pixel" else way, *cells])
    return markdown_table(["200x200, one ray a pixel", *NETWORKS.values()], lines)


def _gpu_work(result: Result) -> str:
    rows = [row for row in result["rows"] if "milliseconds" not in row and "error" not in row]
    lines = [[row["name"], _seconds(row["seconds"]), f"{row['psnr']:.2f} dB" if "psnr" in row else ""] for row in rows]
    return markdown_table(["", "seconds", "PSNR"], lines)


def _rendering(result: Result) -> str:
    named = {row["name"]: row for row in result["rows"]}
    lines = []
    for name, row in named.items():
        if not (size := re.fullmatch(r"(?:default protocol|(one ray a pixel.*)), (\d+x\d+), one view", name)):
            continue
        baked = None if size[1] else named.get(f"baked, {size[2]}")
        over = f"{row['speedup']:.0f} ({row['speedup_lowest']:.0f} to {row['speedup_highest']:.0f})"
        adapting = _seconds(row["adapt_seconds"] + row["refine_seconds"])
        times = [_seconds(row[name]) for name in ("plain_seconds", "reference_seconds", "seconds")]
        last = [_seconds(baked["seconds"]), f"{baked['psnr_loss']:.2f} dB"] if baked else ["-", "-"]
        other = f", commit {row['commit']}" if "commit" in row else ""
        how = f", {size[1]}" if size[1] else ""
        ratios = [f"{row['speedup_over_plain']:.0f}", over]
        lines.append([f"{size[2]}{how}{other}", *times, *ratios, f"{row['psnr_loss']:.2f} dB", adapting, *last])
    headings = ["`paper` by PyTorch", "`paper`", "`ray_marching`", "ratio to PyTorch", "ratio", "PSNR lost"]
    headings += ["adapting and refining", "baked"]
    return markdown_table(["one view", *headings, "PSNR lost by baking"], lines)


def _training(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        if found := re.fullmatch(r"packed training, (.+), 512 rays a step", row["name"]):
            rates = [f"{row[name]:.0f}" for name in ("reference_rays_per_second", "rays_per_second")]
            over = f"{row['speedup']:.1f} ({row['speedup_low']:.1f} to {row['speedup_high']:.1f})"
            memory = [f"{row[name]:.0f} MB" for name in ("reference_peak_megabytes", "peak_megabytes")]
            lines.append([found[1], *rates, over, *memory])
    headings = ["`paper`, rays/s", "`ray_marching`, rays/s", "ratio", "memory, `paper`", "`ray_marching`"]
    return markdown_table(["preset", *headings], lines)


PARTS = {
    "update": "the hypernetwork, forward",
    "rays": "rays and their colours",
    "rendering": "the field at the samples, forward",
    "gradients": "backward, of both",
    "optimisers": "the optimisers",
}
"""The parts of a training step, by the names of the profiler's events."""


def _steps(result: Result) -> str:
    found = {row["name"]: row["seconds"] for row in result["rows"]}
    step = next(row for row in result["rows"] if row["name"].startswith("step of small"))
    times = f"**{_seconds(step['seconds'])}**", _seconds(step["reference_seconds"]), f"{step['speedup']:.2f}"
    lines = [["a step", *times], ["a step in single precision", _seconds(step["single_precision_seconds"]), "", ""]]
    for part, name in PARTS.items():
        seconds = [found[f"part of a step, {way}: {part}"] for way in ("ours", "reference")]
        lines.append([name, *map(_seconds, seconds), f"{seconds[1] / seconds[0]:.2f}"])
    lines.append(["an episode, its pictures in memory", _seconds(found["an episode, its pictures in memory"]), "", ""])
    return markdown_table(["", "now", "every sample differentiated", "ratio"], lines)


def _small(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        times = [f"**{_seconds(row['seconds'])}**", _seconds(row["reference_seconds"]), f"{row['speedup']:.1f}"]
        quality = [f"{row['psnr']:.2f} dB", f"{row['psnr_loss']:.2f} dB"]
        lines.append([row["name"].split(", ")[2], *times, *quality, _seconds(row["adapt_seconds"])])
    headings = ["a view", "reference", "ratio", "PSNR", "lost", "adapting, once"]
    return markdown_table(["picture", *headings], lines)


def _splats(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        kind = row["name"].split(", ")[1].partition("-")[0]
        quality = [f"{row[name]:.2f} dB" for name in ("field_psnr", "voxel_psnr", "psnr")]
        lines.append([kind, *quality, f"{row['splats']:,}", _seconds(row["fit_seconds"])])
    return markdown_table(["", "the model's field", "voxels", "splats", "number", "fitted in"], lines)


NETWORKS = {"paper-network": "paper's network", "small": "`small`"}
WAYS_TO_DRAW = ("default", "one ray a pixel", "paper's protocol")


def _captures(result: Result) -> str:
    lines = []
    for row in result["rows"]:
        found = [f"{row['posed']} of {row['views']}", f"{row['within_half_degree_1_percent']:.0%}"]
        scores = [row.get(name) for name in ("psnr_true", "psnr", "psnr_loss", "psnr_nearest")]
        quality = ["-" if score is None else f"{score:.2f} dB" for score in scores]  # None: not measured
        lines.append([row["name"], *found, f"{row['mask_iou']:.3f}", *quality])
    headings = ["posed", "right poses", "masks", "true poses and masks", "as found", "lost", "nearest photograph"]
    return markdown_table(["", *headings], lines)


WAYS = {
    "damaged": "masks damaged on purpose, as they are",
    "damaged_one_word": "the same, corrected by a hull from which one mask removes a point",
    "damaged_vote": "the same, corrected by a hull from which several masks have to, as `capture` does",
    "learned_background": "no masks, learned background",
    "no_masks": "no masks",
}
"""Other masks that the quality is measured with, by the names in rows of captures."""


def _captures_masks(result: Result) -> str:
    rows = [row for row in result["rows"] if all(f"psnr_{way}" in row for way in WAYS)]
    lines = [["as `capture` found them", *(f"{row['psnr']:.2f} dB ({row['mask_iou']:.3f})" for row in rows)]]
    for way, label in WAYS.items():
        shares = (f" ({row[f'mask_iou_{way}']:.3f})" if f"mask_iou_{way}" in row else "" for row in rows)
        found = [row[f"psnr_{way}"] for row in rows]  # null where nothing could be rendered
        quality = ["-" if psnr is None else f"{psnr:.2f} dB" for psnr in found]
        lines.append([label, *(map("".join, zip(quality, shares, strict=True)))])
    return markdown_table(["masks", *(row["name"] for row in rows)], lines)


VARIANTS = {
    "whole": "whole",
    "without_depth": "every view that shows a point sees it: without the depth of the hull",
    "without_coverage": "without the coverage of the masks",
    "without_order": "views of a point in the order of the object's, not sorted",
    "without_blending": "colours by the network alone, not blended",
    "random_start": "first weights at random, not those of the hull",
}
"""What each variant changes, by the names in rows of image_based."""


def _image_based(result: Result) -> str:
    counts = [name for name in result["rows"][0] if re.fullmatch(r"psnr_\d+", name)]
    lines = []
    for row in result["rows"]:
        lines.append([VARIANTS.get(row["name"], row["name"]), *(f"{row[name]:.2f}" for name in counts)])
    return markdown_table(["", *(f"{name.removeprefix('psnr_')} views" for name in counts)], lines)


OF_QUALITY = ("views", "image_based")  # benchmarks without times
OF_VIEWS = ("views_procedural", "views_cc0", "views_random", "views_posed")
SOURCES = {
    "captures_masks": ("captures",),
    "gpu_ways": ("gpu",),
    "gpu_work": ("gpu",),
    "views": OF_VIEWS,
    "views_over": OF_VIEWS,
    "views_srn": ("views_srn", "views_srn_2"),
    "views_residuals": OF_VIEWS,
    "views_tuned": ("views_tuned", "views_tuned_posed"),
    "views_summary": OF_VIEWS,
}
"""The results that a table is made from, if not from the one of its own name."""
TABLES: dict[str, Callable[..., str]] = {
    "adapting": _adapting,
    "baked": _baked,
    "busy": _busy,
    "captures": _captures,
    "captures_masks": _captures_masks,
    "generation": _generation,
    "gpu": _gpu,
    "gpu_ways": _gpu_ways,
    "gpu_work": _gpu_work,
    "image_based": _image_based,
    "lookup": _lookup,
    "lookup_gpu": _lookup,
    "rendering": _rendering,
    "small": _small,
    "splats": _splats,
    "steps": _steps,
    "training": _training,
    "views": views,
    "views_over": views_over,
    "views_srn": views,
    "views_rotated": views,
    "views_summary": views_summary,
    "views_residuals": views_residuals,
    "views_tuned": views_tuned,
}
"""For each table, the function that makes it from results."""
