"""Numbers of the paper's ablations, as printed, to stand beside ours."""

from dataclasses import dataclass, field

METRICS = ("RRA@5", "RTA@5", "ATE")
"""Columns of every ablation of the paper: percent of pairs, percent, and an error."""


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """One table."""

    title: str
    """What is varied."""
    source: str
    """Which table it is."""
    benchmark: str
    """What its numbers were measured on."""
    header: str
    """Name of the first column."""
    rows: dict[str, tuple[float, float, float]]
    """:data:`METRICS` by name of a sweep's row."""
    labels: dict[str, str] = field(default_factory=dict)
    """How a row is called in the table, where not by its name."""
    unranked: tuple[str, ...] = ()
    """Rows that compete with none: upper bounds."""
    notes: tuple[str, ...] = ()
    """What the paper leaves open, or says twice and differently."""


_ONE_RUN = (
    "The rows L = 4, lambda = 0.1 and DUSt3R of the paper's three ablation tables are one training"
    " (35.7 / 36.9 / 0.032)."
)
_MAIN_MODEL = (
    "The last row is the paper's main model at 512, the row of 200 views in its main table"
    " (52.4 / 53.1 / 0.016)."
)
_COURTHOUSE = (
    "The paper gives this model's seconds on Courthouse twice, and differently: 135.8 in"
    " tables/runtime, 177.4 in tables/supp/tt_runtimes_all_part2."
)

PAPER_TABLES = {
    "num_layers": PaperTable(
        title="Latent alignment layers L",
        source="supplement, tables/supp/abl_num_latent_alignment_layers",
        benchmark="Tanks and Temples, 100 views, trained at 224x224",
        header="L",
        rows={"2": (33.1, 35.5, 0.033), "4": (35.7, 36.9, 0.032), "8": (35.3, 36.9, 0.032)},
        notes=(_ONE_RUN,),
    ),
    "global_weight": PaperTable(
        title="Weight of the global loss lambda",
        source="supplement, tables/supp/abl_global_loss_weight",
        benchmark="Tanks and Temples, 100 views, trained at 224x224",
        header="lambda",
        rows={"0.01": (30.6, 33.3, 0.034), "0.1": (35.7, 36.9, 0.032), "1": (34.5, 36.8, 0.031)},
        notes=(_ONE_RUN,),
    ),
    "graph_size": PaperTable(
        title="Images of a training graph N",
        source="supplement, tables/supp/abl_training_graph_size",
        benchmark="Tanks and Temples, all views, trained at 224x224",
        header="N",
        rows={
            "3": (37.3, 38.1, 0.033),
            "5": (38.0, 39.4, 0.030),
            "8": (39.0, 39.5, 0.030),
            "10": (39.2, 40.7, 0.031),
        },
        notes=(
            "The paper gives 224x224 with N = 8 on all views twice, and differently: 39.0 / 39.5 /"
            " 0.030 here, 32.9 / 34.5 / 0.017 in its comparison with Spann3R"
            " (tables/ours_vs_spann3r_new). The start of this table's trainings is not stated.",
            "256 images a step: round(256 / N) graphs, as the paper keeps images a step equal.",
        ),
    ),
    "init": PaperTable(
        title="Start of the pairwise network",
        source="supplement, tables/supp/abl_backbone_init",
        benchmark="Tanks and Temples, 100 views, trained at 224x224",
        header="Start",
        rows={
            "scratch": (0.7, 0.1, 0.057),
            "dust3r": (35.7, 36.9, 0.032),
            "mast3r": (34.6, 38.6, 0.032),
        },
        labels={
            "scratch": "Scratch",
            "pairwise": "pairwise network",
            "dust3r": "DUSt3R",
            "mast3r": "MASt3R",
        },
        notes=(
            _ONE_RUN,
            "The head follows the file of the start: linear for DUSt3R at 224, DPT for MASt3R.",
        ),
    ),
    "alignment_supervision": PaperTable(
        title="Global supervision and latent alignment, part (a)",
        source="main paper, tables/ablat_model",
        benchmark="Tanks and Temples, 200 views, trained at 512",
        header="Model",
        rows={
            "neither": (47.5, 48.3, 0.019),
            "alignment": (50.8, 48.7, 0.016),
            "dust3r": (48.8, 48.8, 0.016),
            "both": (52.4, 53.1, 0.016),
        },
        labels={
            "neither": "neither",
            "alignment": "alignment alone",
            "global_loss": "global loss alone",
            "dust3r": "both, from DUSt3R",
            "both": "both",
        },
        notes=(_MAIN_MODEL, _COURTHOUSE),
    ),
    "graph": PaperTable(
        title="Construction of the tree, part (b)",
        source="main paper, tables/ablat_model",
        benchmark="Tanks and Temples, 200 views, trained at 512",
        header="Tree",
        rows={
            "oracle": (52.8, 53.8, 0.016),
            "mst": (44.4, 39.5, 0.017),
            "spt": (52.4, 53.1, 0.016),
        },
        labels={"oracle": "oracle (true overlap)", "mst": "MST", "spt": "SPT"},
        unranked=("oracle",),
        notes=(
            _MAIN_MODEL,
            _COURTHOUSE,
            "The paper does not say whether networks were trained anew for each tree; here one"
            " network, trained with SPT, is scored with each.",
        ),
    ),
}
"""By the name that a sweep file gives as ``table``."""
