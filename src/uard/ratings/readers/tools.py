"""The exports of annotation tools, as rows of one answer each.

A row has the columns ``item``, ``annotator``, ``created_at`` if the tool says when, and a column per question, named as
potato names its columns (``question:::``), so that one that is called ``item`` is no item.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from uard import _checks
from uard.ratings.readers.layout import SCHEMA
from uard.ratings.readers.long_form import chosen_value

Row = dict[str, Any]
_NOT_GIVEN = ("discarded", "draft", "pending")  # Argilla's answers that nobody stands by
_CHOSEN = {"rating": "rating", "number": "number", "choices": "choices"}  # Label Studio: type of a result -> its value


def rows_of(first: Row, path: Path, named: Collection[str]) -> Callable[[Row], Iterator[Row]] | None:
    """Return what makes rows of the entries of a file, or None if they are rows.

    Args:
        first: The first entry, by which the tool is known.
        path: Of the file.
        named: Columns that are taken from the data of an entry, such as ``reward``.
    """
    if isinstance(first.get("annotations"), list) and isinstance(first.get("data"), dict):
        return lambda task: label_studio(task, path, named)
    if isinstance(first.get("label_annotations"), dict) or "instance_id_to_label_to_value" in first:
        return lambda entry: potato(entry, path)
    if _is_argilla(first):
        return lambda record: argilla(record, named)
    return None


def label_studio(task: Row, path: Path, named: Collection[str] = ()) -> Iterator[Row]:
    """Yield the answers of a task of Label Studio's export "JSON" (1.0 and later), which lists tasks.

    Answers are the results of type ``rating``, ``number`` and ``choices`` of all annotations that were not cancelled.
    The item is the task's id, the rater ``completed_by`` (the e-mail if it is there), the question ``from_name``.

    Examples:
        >>> answer = {"from_name": "quality", "type": "rating", "value": {"rating": 4}}
        >>> task = {"id": 1, "data": {}, "annotations": [{"completed_by": 7, "result": [answer]}]}
        >>> list(label_studio(task, Path("export.json")))
        [{'annotator': 7, 'created_at': None, 'item': 1, 'quality:::': 4}]

    Args:
        task: With ``annotations`` and ``data``.
        path: Of the file, for messages.
        named: Columns that are taken from ``data``.

    Raises:
        InvalidValueError: an annotation answers a question more than once, with several choices or by region.
    """
    task_id = task.get("id")
    data = _mapping(task.get("data"))
    more = {name: data[name] for name in named if name in data}
    for annotation in map(_mapping, _list(task.get("annotations"))):
        if annotation.get("was_cancelled"):
            continue
        answers: Row = {}
        for result in map(_mapping, _list(annotation.get("result"))):
            key = _CHOSEN.get(str(result.get("type")))
            if key is None:
                continue
            question, value = f"{result.get('from_name')}{SCHEMA}", _mapping(result.get("value")).get(key)
            values = cast("list[Any]", value) if isinstance(value, list) else [value]
            if question in answers or len(values) != 1:
                where = f"{path}: task {task_id}, {result.get('from_name')}"
                raise _checks.InvalidValueError(
                    where, values, "one answer per annotation: of the whole item, one choice"
                )
            answers[question] = values[0]
        when = annotation.get("updated_at") or annotation.get("created_at")
        if answers:
            yield more | {"annotator": annotation.get("completed_by"), "created_at": when} | {"item": task_id} | answers


def argilla(record: Row, named: Collection[str] = ()) -> Iterator[Row]:
    """Yield the answers of one of Argilla's records, as its versions 1.x and 2.x write them.

    2.x (``records.to_json``): ``responses`` holds, by question, lists of ``user_id`` and ``value``. 1.x (feedback
    datasets): ``responses`` is a list of ``user_id`` and ``values``; in data sets of the hub each question is a column
    of lists like those of 2.x. Answers that are discarded, drafts or pending are left out. The item is the record's
    id, or else its external id.

    Examples:
        >>> list(argilla({"id": 1, "responses": {"quality": [{"value": 4, "user_id": "ann"}]}}))
        [{'item': 1, 'annotator': 'ann', 'created_at': None, 'quality:::': 4}]

    Args:
        record: One record.
        named: Columns that are taken from its ``metadata`` or ``fields``.
    """
    item = next((record[n] for n in ("id", "_server_id", "external_id") if record.get(n) is not None), None)
    data = {**_mapping(record.get("fields")), **_mapping(record.get("metadata")), **record}
    more = {name: data[name] for name in named if name in data}
    responses: Any = record.get("responses", {name: x for name, x in record.items() if _is_answers(x)})
    if isinstance(responses, dict):
        by_question = cast("dict[str, Any]", responses)
        given = [
            (q, _mapping(a), _mapping(a).get("value")) for q, answers in by_question.items() for a in _list(answers)
        ]
    else:
        given = [
            (q, _mapping(a), _mapping(value).get("value", value))
            for a in _list(responses)
            for q, value in _mapping(_mapping(a).get("values")).items()
        ]
    for question, answer, value in given:
        if answer.get("status") not in _NOT_GIVEN:
            when = answer.get("updated_at") or answer.get("inserted_at")
            yield (
                more
                | {"item": item, "annotator": answer.get("user_id"), "created_at": when}
                | {f"{question}{SCHEMA}": value}
            )


def _is_argilla(record: Row) -> bool:
    """Whether these are responses of Argilla's, and not those of a model, which a log may have in such a column too."""
    responses: Any = record.get("responses")
    if not responses:
        return {"responses", "fields"} <= record.keys() or any(_is_answers(x) for x in record.values())
    by_question = isinstance(responses, dict) and all(isinstance(x, list | None) for x in _mapping(responses).values())
    return by_question or any("values" in _mapping(x) for x in _list(responses))


def _is_answers(cell: Any) -> bool:
    return bool(_list(cell)) and {"user_id", "value"} <= _mapping(_list(cell)[0]).keys()


def potato(entry: Row, path: Path) -> Iterator[Row]:
    """Yield the answers of a line of potato's JSONL (1.x, one line per item) or of its JSON (2.x, one user per file).

    A line that does not say whose it is belongs to the user after whom potato names the file's folder.

    Examples:
        >>> line = {"user_id": "ann", "id": "1", "label_annotations": {"quality": {"scale_4": "4"}}}
        >>> list(potato(line, Path("annotated_instances.jsonl")))
        [{'item': '1', 'annotator': 'ann', 'quality:::': '4'}]

    Args:
        entry: A line with ``label_annotations``, or a user with ``instance_id_to_label_to_value``.
        path: Of the file.

    Raises:
        InvalidValueError: several labels are chosen in one question, or it cannot be told who has answered.
    """
    user = entry.get("user_id") or entry.get("user") or path.absolute().parent.name
    if path.name.startswith("annotated_instances") and path.absolute().parent.name == "annotation_output":
        allowed = (
            "potato's CSV or TSV (output_annotation_format), or one user's file: this one does not say who answered"
        )
        raise _checks.InvalidValueError("log", str(path), allowed)
    items: Mapping[str, Any] = _mapping(entry.get("instance_id_to_label_to_value")) or {
        str(entry.get("instance_id") or entry.get("id")): entry.get("label_annotations")
    }
    for item, answers in items.items():
        row: Row = {"item": item, "annotator": user}
        for question, chosen in _mapping(answers).items():
            labels = _mapping(chosen).get("labels", chosen)
            row[f"{question}{SCHEMA}"] = chosen_value(dict(_mapping(labels)), f"{path}: item {item}, {question}")
        if len(row) > 2:
            yield row


def _mapping(x: Any) -> Mapping[str, Any]:
    return cast("Mapping[str, Any]", x) if isinstance(x, Mapping) else {}


def _list(x: Any) -> list[Any]:
    return cast("list[Any]", x) if isinstance(x, list) else []
