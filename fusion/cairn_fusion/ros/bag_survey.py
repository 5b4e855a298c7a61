"""A bag that somebody hands us: what is in it, what to take of it, and its scans if there is no doubt."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cairn_fusion.ros.bag_index import BagIndex, index_bag
from cairn_fusion.ros.bag_recording import BagRecording, open_bag_recording
from cairn_fusion.ros.open_bag import open_bag
from cairn_fusion.ros.topic_mapping import BagMapping, mapping_from_yaml
from cairn_fusion.ros.topic_proposal import Proposal, propose
from cairn_map.errors import BadInputError


@dataclass(frozen=True, slots=True)
class Survey:
    """All topics of a bag, and the mapping proposed for it."""

    path: Path
    index: BagIndex
    proposal: Proposal


def survey(path: Path, *, on_message: Callable[[], object] | None = None) -> Survey:
    """Look through a whole bag.

    Raises:
        BadInputError: no bag, or the libraries that read bags are not installed.
        DamagedDataError: it is damaged.
    """
    bag = open_bag(path)
    try:
        index = index_bag(bag, on_message=on_message)
        return Survey(path, index, propose(index, path))
    finally:
        bag.close()


def open_any_bag(path: Path, mapping: BagMapping | None, *, scans_per_measurement: int | None = None) -> BagRecording:
    """The scans of a bag by a mapping, or by the proposed one where nothing is left to decide.

    Raises:
        BadInputError: `undecided`: the message lists the questions; else as `open_bag_recording`.
        DamagedDataError: it is damaged.
    """
    if mapping is None:
        proposal = survey(path).proposal
        if proposal.questions:
            asked = "; ".join(proposal.questions)
            raise BadInputError(
                "undecided",
                f"{path} leaves something to decide: {asked}. Write a file by `cairn robot inspect {path} --output "
                "bag.yaml`, edit it, and give it with --topics bag.yaml",
            )
        mapping = mapping_from_yaml(proposal.text, f"the topics proposed for {path}")
    return open_bag_recording(path, mapping, scans_per_measurement=scans_per_measurement)
