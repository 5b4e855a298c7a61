"""What is said about a commit whose bytes come in parts."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from cairn_map.wire.messages import ShaText


class Upload(BaseModel):
    """Answer to a part, and to who asks how many are there."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    size_bytes: Annotated[int, Field(ge=0)]
    """So many of the body's bytes are here, from its first one on: the next part begins there."""
    sha: ShaText | None = None
    """Of the commit that is kept for good under this id; None: none yet."""
