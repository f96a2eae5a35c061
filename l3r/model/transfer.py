"""From a file of weights to a network: what is loaded, what is fresh, what is left out."""

import io
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Literal

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor, nn

from l3r.config import DecoderConfig, EncoderConfig, ModelConfig
from l3r.errors import CheckpointError
from l3r.model.weights import official_key, printable, room_of, take_weights

ROOMS = ("encoder", "decoder", "parent_head", "child_head", "alignment")
"""The parts of the network, each loaded as a whole or not at all."""


Fate = Literal["loaded", "copied", "fresh", "ignored", "second name"]


@dataclass(frozen=True, kw_only=True)
class Row:
    """What became of some weights."""

    part: str
    """Room of ours, or family of the file."""
    fate: Fate
    """``copied`` and ``fresh`` ones are not in the file, ``ignored`` ones not in the network."""
    num_entries: int
    """Entries of the state dict."""
    num_parameters: int
    """Numbers in them; none in a second name of a tensor."""
    remark: str = ""
    """Why."""


@dataclass(frozen=True, kw_only=True)
class WeightSource:
    """The weights of a file, under our names, and what is known of it."""

    where: str
    """The file, for messages."""
    kind: str
    """What it is, in words."""
    config: ModelConfig
    """Sizes of what ``rooms`` names."""
    rooms: frozenset[str]
    """The parts that the file should hold."""
    weights: Mapping[str, Tensor]
    """Of the network."""
    copied: frozenset[str] = frozenset()
    """Of ``weights``, those that the file lacks."""
    leftover: tuple[Row, ...] = ()
    """What else the file holds."""
    is_official: bool = False
    """Whether messages spell names as DUSt3R, MASt3R and CroCo do."""
    step: int | None = None
    """Training steps, where the file says so."""
    note: str = ""
    """What whoever uses the weights should know."""

    def spell(self, key: str) -> str | None:
        """Name a weight as the file does."""
        return official_key(key) if self.is_official else key


@dataclass(frozen=True, kw_only=True)
class Transfer:
    """What goes from a source into one network."""

    weights: dict[str, Tensor]
    """To load, under the network's names."""
    rows: tuple[Row, ...]
    """The fate of every weight of both sides."""

    def count(self, *fates: Fate) -> int:
        """Count the parameters of these fates."""
        return sum(row.num_parameters for row in self.rows if row.fate in fates)

    def to_table(self) -> str:
        """Lay out as a table of at most 80 columns."""
        table = Table(box=None, pad_edge=False)
        for name in ("part", "fate", "entries", "parameters", "remark"):
            is_number = name in ("entries", "parameters")
            justify: Literal["left", "right"] = "right" if is_number else "left"
            table.add_column(name, justify=justify, no_wrap=name != "remark")
        for row in self.rows:
            numbers = (f"{row.num_entries:,}", f"{row.num_parameters:,}")
            table.add_row(row.part, row.fate, *numbers, row.remark)
        loaded, ignored = self.count("loaded"), self.count("ignored")
        made = self.count("copied", "fresh")
        stream = io.StringIO()
        console = Console(file=stream, width=80, highlight=False, markup=False)
        console.print(table)
        console.print(f"file: {loaded:,} parameters loaded + {ignored:,} ignored")
        console.print(f"network: {loaded:,} parameters loaded + {made:,} copied or fresh")
        return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()) + "\n"


def plan_transfer(source: WeightSource, network: nn.Module, config: ModelConfig) -> Transfer:
    """Decide what becomes of every weight; looks at names and shapes alone.

    Encoder and decoder must fit. Heads and alignment are left fresh where the file has none, or
    others.

    Args:
        source: The file.
        network: What to fill; may be on the meta device.
        config: Its sizes.

    Raises:
        CheckpointError: Sizes differ, weights are missing, unknown or of another shape.
    """
    for name in ("encoder", "decoder"):
        found, expected = getattr(source.config, name), getattr(config, name)
        if found != expected:
            raise CheckpointError(
                f"{source.where}: its {name} has {_sizes(found)}, this network's has "
                f"{_sizes(expected)}; change model.{name} or take another file"
            )
    wanted = network.state_dict()
    reasons = {room: _reason_for_fresh(room, source, config) for room in ROOMS}
    expected_keys = [key for key in wanted if reasons[room_of(key)] is None]
    try:
        _refuse_strays(source)
        chosen = take_weights(source.weights, expected_keys, source.spell)
        for key, value in chosen.items():
            if value.shape != wanted[key].shape:
                shapes = list(value.shape), list(wanted[key].shape)
                raise CheckpointError(
                    f"{source.spell(key)} is of shape {shapes[0]}, expected {shapes[1]}; the file "
                    "contradicts its own configuration"
                )
    except CheckpointError as error:
        raise CheckpointError(f"{source.where}: {error}") from error
    rows = (row for room in ROOMS for row in _rows_of(room, source, wanted, reasons[room]))
    return Transfer(weights=chosen, rows=(*rows, *source.leftover))


def fill_network(network: nn.Module, transfer: Transfer, source: WeightSource) -> None:
    """Copy the weights in, as the network's own type; fresh parts stay as they are.

    Raises:
        CheckpointError: A weight is not finite.
    """
    for key, value in transfer.weights.items():
        require_finite(value, source.spell(key) or key, source.where)
    network.load_state_dict(transfer.weights, strict=False)


def require_weights(content: object, where: str) -> dict[str, Tensor]:
    """Check that something read from a file is a state dict of floating-point tensors.

    Args:
        content: Any object.
        where: The file, for the message.

    Raises:
        CheckpointError: It is something else.
    """
    if not isinstance(content, Mapping):
        raise CheckpointError(
            f"{where}: its weights are a {type(content).__name__}, expected a dict of tensors"
        )
    for key, value in content.items():
        if not isinstance(value, Tensor):
            found = f"a {type(value).__name__}"
        elif value.is_nested:
            found = "a nested tensor"
        elif value.layout != torch.strided or not value.is_floating_point():
            found = f"a {value.layout} tensor of {value.dtype}".replace("torch.", "")
        elif value.untyped_storage().nbytes() < value.numel() * value.element_size():
            found = "a tensor larger than what is stored of it"
        elif not isinstance(key, str):
            found = "no name"
        else:
            continue
        raise CheckpointError(
            f"{where}: {printable(key)} is {found}, expected named tensors of floating-point "
            "numbers"
        )
    return dict(content)


def require_finite(weight: Tensor, name: str, where: str) -> None:
    """Check that a weight has values, and that float32 can hold them.

    Args:
        weight: Any floating-point tensor.
        name: Of the weight, for the message.
        where: The file, for the message.

    Raises:
        CheckpointError: It is on the meta device, or a value is not finite.
    """
    if weight.is_meta or not weight.float().isfinite().all():
        raise CheckpointError(
            f"{where}: {printable(name)} holds values that are not finite in float32; fetch or "
            "write the file again"
        )


def count_parameters(weights: Iterable[Tensor]) -> int:
    """Count the numbers in tensors."""
    return sum(value.numel() for value in weights)


def _refuse_strays(source: WeightSource) -> None:
    strays = sorted(
        source.spell(key) or key for key in source.weights if room_of(key) not in source.rooms
    )
    if strays:
        raise CheckpointError(
            f"has {len(strays)} weights of parts that its configuration does not name "
            f"({printable(strays[0])}, ..), expected none"
        )


def _reason_for_fresh(room: str, source: WeightSource, config: ModelConfig) -> str | None:
    """Say why a part cannot come from the file; None if it must."""
    if room == "alignment":
        if room in source.rooms and source.config.alignment == config.alignment:
            return None
        is_identity = config.alignment.output == "zero_linear"
        return "identity until trained" if is_identity else "random: no identity"
    if room not in source.rooms:
        return "not in the file"
    if room.endswith("head") and source.config.head != config.head:
        return f"the file's is {source.config.head}"
    if room.endswith("head") and config.head == "dpt" and source.config.dpt != config.dpt:
        return "the file's has other channels"
    return None


def _rows_of(
    room: str, source: WeightSource, wanted: Mapping[str, Tensor], reason: str | None
) -> Iterable[Row]:
    """Account for the weights of one part, ours and the file's."""
    mine = {key: value for key, value in wanted.items() if room_of(key) == room}
    theirs = {key: value for key, value in source.weights.items() if room_of(key) == room}
    stored = {key: value for key, value in theirs.items() if key not in source.copied}
    copied = {key: value for key, value in theirs.items() if key in source.copied}
    name = room.replace("_", " ")
    if reason is None:
        yield from build_rows(name, "loaded", stored)
        yield from build_rows(name, "copied", copied, "child's stream = parent's")
    else:
        yield from build_rows(name, "fresh", mine, reason)
        yield from build_rows(f"{name} of the file", "ignored", stored, "does not fit")


def build_rows(
    part: str, fate: Fate, weights: Mapping[str, Tensor], remark: str = ""
) -> Iterable[Row]:
    """Make the row of some weights; none if there are none."""
    if weights:
        yield Row(
            part=part,
            fate=fate,
            num_entries=len(weights),
            num_parameters=count_parameters(weights.values()),
            remark=remark,
        )


def _sizes(config: EncoderConfig | DecoderConfig) -> str:
    return ", ".join(f"{key} {value}" for key, value in asdict(config).items())
