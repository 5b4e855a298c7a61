"""What a robot's commit says of itself, but for its number."""

from pydantic import ValidationError

from cairn_calib.rig.rig import Rig
from cairn_client.replica.outbox import UNNUMBERED
from cairn_client.replica.replica import Replica
from cairn_fusion.mapping.integrate import Integrator
from cairn_fusion.mapping.measurement import Measurement
from cairn_map.commits.commit import CommitMeta
from cairn_map.commits.ids import CommitId
from cairn_map.errors import BadInputError, first_error


def own_meta(
    replica: Replica,
    measurement: Measurement | None,
    rig: Rig | None,
    integrator: Integrator,
    *,
    note: str,
    retracts: tuple[CommitId, ...],
) -> CommitMeta:
    """What the commit of a measurement says; the replica gives the number.

    Raises:
        BadInputError: a note that is too long, or more than a commit can take back.
    """
    try:
        return CommitMeta(
            id=str(CommitId(replica.author, UNNUMBERED)),
            geometry=replica.geometry.digest().hex(),
            captured_s=measurement.captured_s if measurement else None,
            scans=tuple(measurement.poses) if measurement else (),
            sensors=tuple(rig.cameras) if rig else (),
            rig=rig.digest() if rig else None,
            integrator=str(integrator),
            retracts=tuple(str(target) for target in retracts),
            note=note,
        )
    except ValidationError as exc:
        raise BadInputError("bad_meta", f"the commit cannot say this of itself: {first_error(exc)}") from exc
