"""The doctor: which known traps a log of rewards and ratings is in, and what avoids them."""

from uard.diagnosis.case import PRINTED
from uard.diagnosis.doctor import CODES, doctor, filtered
from uard.diagnosis.finding import SEVERITIES, Diagnosis, Finding, Stratum

__all__ = ["CODES", "PRINTED", "SEVERITIES", "Diagnosis", "Finding", "Stratum", "doctor", "filtered"]
