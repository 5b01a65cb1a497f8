"""JSON records that only programs write, such as lines of a journal and messages between programs."""

import json
from functools import cached_property
from typing import Any, Generic, TypeVar

from fieldkit.config.schema import TypeAdapter, ValidationError

Record = TypeVar("Record")


class Codec(Generic[Record]):
    """Converts records of one type to JSON values and back, for lines of a journal and messages between programs.

    A field with another name in the file is declared as `Annotated[str, Field(alias="other")]`.

    Args:
        record: The type, for example a frozen dataclass whose fields are annotated.
    """

    def __init__(self, record: type[Record]) -> None:
        self._record = record

    @cached_property
    def _adapter(self) -> TypeAdapter[Record]:
        return TypeAdapter(self._record)  # at first use: it takes 10 ms, and a command uses few adapters

    def parse(self, data: Any) -> Record:  # noqa: ANN401 (any JSON value)
        """Return the record of a JSON value.

        A missing field has its default; values are not converted to other types.

        Raises:
            ValueError: The value is not such a record.
        """
        try:
            # In strict mode pydantic accepts lists for tuples and words for enumerations only in JSON text.
            # An unpaired surrogate is replaced, because the parser of pydantic rejects it, although the parser of
            # Python accepts it.
            text = json.dumps(data, ensure_ascii=False).encode(errors="replace")
            return self._adapter.validate_json(text, strict=True)
        except ValidationError as error:
            first_error = error.errors()[0]
            place = ".".join(map(str, first_error["loc"]))
            raise ValueError(f"{place}: {first_error['msg']}" if place else first_error["msg"]) from error

    def dump(self, record: Record) -> Any:  # noqa: ANN401 (any JSON value)
        """Return the JSON value that `parse` converts back to an equal record."""
        return self._adapter.dump_python(record, mode="json", by_alias=True)
