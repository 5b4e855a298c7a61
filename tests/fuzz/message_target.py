"""Every message that client and server exchange, as JSON."""

from pydantic import BaseModel
from tests.fuzz.sections import sections_of

from cairn_map.errors import BadInputError
from cairn_map.wire import (
    access_messages,
    live_events,
    messages,
    relay_peer,
)

MODULES = (access_messages, live_events, messages, relay_peer)
MODELS: dict[str, type[BaseModel]] = {
    name: model
    for module in MODULES
    for name, model in vars(module).items()
    if isinstance(model, type) and issubclass(model, BaseModel) and model.__module__ == module.__name__
}


def read_message(data: bytes) -> None:
    """`=== Model`, then its JSON: every message that client and server exchange."""
    for name, text in sections_of(data):
        if name in MODELS:
            message = messages.message_from_json(MODELS[name], text)
            again = messages.message_from_json(MODELS[name], message.model_dump_json())
            assert again.model_dump_json() == message.model_dump_json()
            check_properties(message)


def check_properties(message: object) -> None:
    """Every parsed form of a message's texts; each may refuse what it holds."""
    for name, value in vars(type(message)).items():
        if isinstance(value, property):
            try:
                getattr(message, name)
            except BadInputError:
                continue
