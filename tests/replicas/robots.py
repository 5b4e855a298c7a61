"""Robots that push through any server of a site, each again until it is acknowledged."""

import random
import threading
import time
from dataclasses import dataclass, field

import httpx
from tests.crash.lives import commit_of
from tests.fixtures.server.deadline import until
from tests.replicas.site import Site

from cairn_map.commits.commit import Commit
from cairn_map.commits.ids import Author, CommitId, Incarnation, RobotName

AGAIN_SHARE = 0.1
"""Share of pushes after which an old commit is pushed again, late."""
LATER = (503, 507)
"""Statuses that a robot may get: it is to come again."""
PAUSE_S = 0.1
TIMEOUT_S = 15.0


@dataclass(slots=True)
class Pushed:
    """What robots know."""

    offered: dict[CommitId, Commit] = field(default_factory=dict)
    acked: set[CommitId] = field(default_factory=set)
    answers: dict[str, int] = field(default_factory=dict)
    """Count of each answer: a status with the problem's kind, or an exception's name."""
    wrong: list[str] = field(default_factory=list)
    """Answers that must not be."""
    last_s: float = field(default_factory=time.monotonic)
    silence_s: float = 0.0
    """Longest time in which no push at all was acknowledged."""
    lock: threading.Lock = field(default_factory=threading.Lock)

    def go_on(self, after: str) -> None:
        """Return when a push was acknowledged from now on."""
        start_s = time.monotonic()
        until(lambda: self.last_s > start_s, f"robots go on after: {after}")

    def note(self, answer: str, commit: Commit | None = None) -> None:
        """Count an answer; with a commit, it was acknowledged."""
        with self.lock:
            self.answers[answer] = self.answers.get(answer, 0) + 1
            if commit is not None:
                self.acked.add(commit.id)
                now_s = time.monotonic()
                self.silence_s, self.last_s = max(self.silence_s, now_s - self.last_s), now_s


class Pusher:
    """One robot, in a thread of its own."""

    def __init__(self, site: Site, pushed: Pushed, number: int, ended: threading.Event) -> None:
        self._site = site
        self._pushed = pushed
        self._author = Author(RobotName(f"robot{number}"), Incarnation(f"{number:016x}"))
        self._ended = ended
        self._random = random.Random(number)
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        with httpx.Client(timeout=TIMEOUT_S) as http:
            n = 0
            while not self._ended.is_set():
                commit = commit_of(self._author, n)
                with self._pushed.lock:
                    self._pushed.offered[commit.id] = commit
                while not self._push(http, commit) and not self._ended.is_set():
                    self._ended.wait(PAUSE_S)
                n += 1
                if self._random.random() < AGAIN_SHARE:
                    self._push(http, commit_of(self._author, self._random.randrange(n)))

    def _push(self, http: httpx.Client, commit: Commit) -> bool:
        """True if it was acknowledged."""
        urls = self._site.urls()
        if not urls:
            return False
        url = f"{self._random.choice(urls)}/maps/lab/commits/{commit.id}"
        try:
            answer = http.put(url, content=commit.data, headers={"Content-Type": "application/vnd.cairn.commit"})
        except httpx.TransportError as exc:
            self._pushed.note(type(exc).__name__)
            return False
        is_kept = answer.status_code in (200, 201)
        kind = "" if is_kept else f" {answer.json().get('kind')}"
        self._pushed.note(f"{answer.status_code}{kind}", commit if is_kept else None)
        if not is_kept and answer.status_code not in LATER:
            self._pushed.wrong.append(f"{commit.id}: {answer.status_code} {answer.text[:200]}")
        return is_kept
