"""Typed configuration in layers; imports no torch."""

from l3r.config.compare import find_changes, flatten_plain
from l3r.config.data import DataConfig, SourceConfig
from l3r.config.graph import GraphConfig
from l3r.config.inference import InferenceConfig
from l3r.config.layers import (
    from_plain,
    load_config,
    load_other,
    override_config,
    to_plain,
    to_yaml,
)
from l3r.config.logs import LogsConfig
from l3r.config.loss import LossConfig
from l3r.config.model import (
    AlignmentConfig,
    DecoderConfig,
    DptConfig,
    EncoderConfig,
    ModelConfig,
    Precision,
)
from l3r.config.run import RunConfig
from l3r.config.train import TrainConfig

__all__ = [
    "AlignmentConfig",
    "DataConfig",
    "DecoderConfig",
    "DptConfig",
    "EncoderConfig",
    "GraphConfig",
    "InferenceConfig",
    "LogsConfig",
    "LossConfig",
    "ModelConfig",
    "Precision",
    "RunConfig",
    "SourceConfig",
    "TrainConfig",
    "find_changes",
    "flatten_plain",
    "from_plain",
    "load_config",
    "load_other",
    "override_config",
    "to_plain",
    "to_yaml",
]
