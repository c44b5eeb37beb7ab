"""The command ``radiosity explain``: what the solver uses and leaves out, and what each decision saves.

Only ``click`` is imported at the top; everything heavy is imported when the command runs.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

import click

__all__ = ["explain"]


def _percent(share: float) -> float | None:
    return None if math.isnan(share) else 100.0 * share


@click.command()
@click.argument("scene")
@click.option(
    "--error",
    type=click.FloatRange(0, 1, min_open=True, max_open=True),
    default=0.05,
    show_default=True,
    metavar="E",
    help="Wanted error of the irradiance.",
)
@click.option("--repeats", type=click.IntRange(1, 100), default=3, show_default=True, metavar="N", help="Timed runs.")
@click.option(
    "--budget-seconds",
    type=click.FloatRange(0, min_open=True),
    default=40.0,
    show_default=True,
    metavar="S",
    help="Processor time of the ablations, after the solve.",
)
@click.option("--seed", type=click.IntRange(0, 2**62), default=0, show_default=True, metavar="S", help="Of the rays.")
@click.option("--workers", type=click.IntRange(1, 1024), metavar="N", help="Threads.  [default: all cores]")
@click.option("-o", "--output", "directory", type=click.Path(path_type=Path), metavar="DIR", help="Write files here.")
def explain(
    scene: str,
    error: float,
    repeats: int,
    budget_seconds: float,
    seed: int,
    workers: int | None,
    directory: Path | None,
) -> None:
    """Say how SCENE is solved to an error, and measure what each decision saves.

    Prints what the solver used and left out: meshes, surfaces not subdivided, lights found exactly or
    sampled, what the cullers set aside, rays.  Then the same work is done with each decision switched
    off; what takes more than 20 times as long then is stopped, and what no time is left for is named.  DIR
    gets explain.csv, explain.png and record.json.
    """
    from workbench.record import check_folder

    check_folder(directory)
    import numpy as np

    import workbench
    from radiosity.report import cost_model, explanation
    from workbench.study.result import StudyResult, format_table, write_study

    loaded = workbench.load(scene)
    for note in loaded.notes:
        click.echo(f"note: {note}", err=True)
    found = explanation.explain(
        loaded, error=error, workers=workers, seed=seed, repeats=repeats, budget_seconds=budget_seconds,
        report=lambda line: click.echo(line, err=True),
    )  # fmt: skip
    record = found.solution.record
    parts = cost_model.read_table()["solve"].parts(record.counters)
    total = sum(parts.values()) or 1.0
    shares = ", ".join(f"{name.replace('_', ' ')} {share / total:.0%}" for name, share in list(parts.items())[:4])
    found.facts.append(f"where the seconds go, by the committed table of costs: {shares}")
    rows = [
        {
            "part": item.part, "decision": item.decision, "without it": item.without,
            "seconds": float(np.median(item.seconds)), "times": item.ratio,
            "stopped": "there" if item.stopped else "", "from": min(item.ratios),
            "to": max(item.ratios), "error_%": _percent(item.error), "without_%": _percent(item.error_without),
        }
        for item in found.ablations
    ]  # fmt: skip
    title = f"{loaded.name} to an error of {error:g}"
    click.echo(title)
    for fact in found.facts:
        click.echo(click.wrap_text(f"- {fact}", width=110, subsequent_indent="  "))
    click.echo(f"\nEach decision switched off:\n\n{format_table(rows)}")
    if directory is not None:
        record.results["ablations"] = [asdict(item) for item in found.ablations]
        result = StudyResult(
            "explain", title, rows, found.facts, record,
            lambda figure: explanation.draw_ablations(figure, found.ablations, f"{title}: what each decision saves"),
        )  # fmt: skip
        for path in write_study(result, directory):
            click.echo(str(path))
