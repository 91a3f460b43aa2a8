"""People rate: clips of agents and texts, several raters at a page, and the long table of who said what.

The page itself needs the extra ``uard[collect]``; stores, projects and what a training run asks of them do not.
"""

from uard.collect.items import Item, clip_item, pair_item, text_item
from uard.collect.project import Project, Question
from uard.collect.sqlite import SQLiteStore
from uard.collect.store import AnswerStore, Request

__all__ = [
    "AnswerStore",
    "Item",
    "Project",
    "Question",
    "Request",
    "SQLiteStore",
    "clip_item",
    "pair_item",
    "text_item",
]
