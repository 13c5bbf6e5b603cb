"""Recall past situations: find the remembered actions most like this one, and count how they ended."""

from typing import TYPE_CHECKING

from pycrorm_async.lazy_names import lazy_names

if TYPE_CHECKING:
    from pycrorm_async.recall.answer import Answer as Answer
    from pycrorm_async.recall.experience import PickUpExperience as PickUpExperience
    from pycrorm_async.recall.prediction import Prediction as Prediction
    from pycrorm_async.recall.recall import CaseReader as CaseReader
    from pycrorm_async.recall.recall import DatabaseSource as DatabaseSource
    from pycrorm_async.recall.recall import Recall as Recall
    from pycrorm_async.recall.running_cases import ProcessCases as ProcessCases

__getattr__ = lazy_names(
    __name__,
    {
        "answer": "Answer",
        "experience": "PickUpExperience",
        "prediction": "Prediction",
        "recall": "CaseReader DatabaseSource Recall",
        "running_cases": "ProcessCases",
    },
)
