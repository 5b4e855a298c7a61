"""Routes for whoever runs the server: probes and figures. Nothing is decided here."""

from fastapi import APIRouter, Depends
from fastapi.responses import PlainTextResponse

from cairn_server.http.routes.callers import Credentials, Operations, admin, anybody
from cairn_server.metrics import MEDIA_TYPE

router = APIRouter()


def metrics_reader(service: Operations, credentials: Credentials) -> None:
    """Pass who may read the figures: an admin, or with `--metrics-open` anybody."""
    if not service.settings.metrics_open:
        admin(anybody(service, credentials))


@router.get("/readyz")
def readyz(service: Operations) -> dict[str, str]:
    """The server can take a push and bring it into the map; else 503 says why not."""
    service.readiness.check()
    return {"status": "ready"}


@router.get("/metrics", response_class=PlainTextResponse, dependencies=[Depends(metrics_reader)])
def metrics(service: Operations) -> PlainTextResponse:
    """Figures for Prometheus."""
    return PlainTextResponse(service.metrics_text(), media_type=MEDIA_TYPE)
