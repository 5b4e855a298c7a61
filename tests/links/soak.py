"""Some robots in the building, a server, bad links, and perhaps somebody who kills all of them, now this, now that."""

import multiprocessing
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.process import BaseProcess
from pathlib import Path
from random import Random

from tests.crash.kills import mortal_server
from tests.links.life import MAP, Building, live
from tests.links.proxy import FaultProxy
from tests.links.verdict import Verdict, verdict_on
from tests.links.weather import Weather

from cairn_client.http.api import MapApi
from cairn_client.sync.link_profile import LinkName
from cairn_map.errors import UnreachableError
from cairn_map.wire.messages import CreateMap

END_S = 60.0
NAMES = ("ant", "bee", "cat")
LINKS: dict[str, LinkName] = {"cat": "small"}
"""One robot's link is small, as it believes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What is to happen."""

    seconds: float
    commit_every_s: float
    """Of each robot, on an average."""
    cut_bytes: float
    """Between two cuts of a connection, on an average."""
    kill_every_s: float | None = None
    has_faults: bool = True
    seed: int = 0


@dataclass(slots=True)
class Outcome:
    """What happened."""

    cuts: int = 0
    connections: int = 0
    server_kills: int = 0
    robot_kills: int = 0
    size_bytes: int = 0
    verdict: Verdict = field(default_factory=Verdict)


class Soak:
    """A server and its robots, each in a process of its own, and each robot's link."""

    def __init__(self, folder: Path, building: Building, plan: Plan) -> None:
        self._folder = folder
        self._building = building
        self._plan = plan
        self._random = Random(plan.seed)
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["tests.links.soak"])
        building.save(folder / "building")
        (folder / "store").mkdir()
        self.outcome = Outcome()
        self._server, self._port = self._started_server()
        self._weather = {name: Weather(Random(f"{plan.seed} {name}"), mean_bytes=plan.cut_bytes) for name in NAMES}
        for weather in self._weather.values():
            weather.is_fair = not plan.has_faults
        with MapApi(f"http://127.0.0.1:{self._port}") as api:
            api.create_map(MAP, CreateMap(geometry=building.geometry))
        self._links = {name: FaultProxy(self._port, fault=self._weather[name]) for name in NAMES}
        self._robots = {name: self._started_robot(name) for name in NAMES}

    def run(self, tell: Callable[[float, Outcome], None] = lambda seconds, outcome: None) -> Outcome:
        """All of it, and the verdict."""
        start_s = time.monotonic()
        told_s = next_kill_s = start_s
        while (now_s := time.monotonic()) < start_s + self._plan.seconds:
            time.sleep(self._random.uniform(0.0, 0.2))
            if self._plan.kill_every_s is not None and now_s >= next_kill_s:
                self._kill()
                next_kill_s = now_s + self._random.expovariate(1 / self._plan.kill_every_s)
            elif self._plan.kill_every_s is None:
                self._check_alive()
            for link in self._links.values():
                link.is_down = self._plan.has_faults and self._random.random() < 0.05
            if now_s > told_s + 60.0:
                told_s = now_s
                tell(now_s - start_s, self._counted())
        for robot in self._robots.values():
            robot.kill()
            robot.join()
        self._counted()
        self.outcome.verdict = verdict_on(self._port, self._folder, list(NAMES), self._building)
        return self.outcome

    def close(self) -> None:
        """End what is left."""
        for link in self._links.values():
            link.__exit__(None, None, None)
        for process in (*self._robots.values(), self._server):
            process.kill()
            process.join(END_S)
        shutil.rmtree(self._folder / "store", ignore_errors=True)

    def _kill(self) -> None:
        """One of them, at this instant; it starts again soon."""
        name = self._random.choice((*NAMES, "server"))
        if name == "server":
            self._server.kill()
            self._server.join(END_S)
            self.outcome.server_kills += 1
            self._server, self._port = self._started_server()
            for link in self._links.values():
                link.server_port = self._port
        else:
            self._robots[name].kill()
            self._robots[name].join(END_S)
            self.outcome.robot_kills += 1
            self._robots[name] = self._started_robot(name)

    def _check_alive(self) -> None:
        dead = [name for name, robot in self._robots.items() if not robot.is_alive()]
        assert not dead, f"{dead} ended by themselves"

    def _started_server(self) -> tuple[BaseProcess, int]:
        while True:
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=mortal_server, args=(str(self._folder / "store"), theirs, None))
            process.start()
            theirs.close()
            try:
                url: str = ours.recv().split()[4].rstrip(",")
            except EOFError:
                process.join(END_S)
                raise AssertionError(f"the server does not start: exit code {process.exitcode}") from None
            port = int(url.rpartition(":")[2])
            try:
                with MapApi(url) as api:
                    api.maps()
            except UnreachableError:
                continue
            return process, port

    def _started_robot(self, name: str) -> BaseProcess:
        seed = self._random.randrange(1 << 30)
        port, every_s = self._links[name].port, self._plan.commit_every_s
        arguments = (port, str(self._folder), name, seed, every_s, LINKS.get(name, "good"))
        process = self._context.Process(target=live, args=arguments)
        process.start()
        return process

    def _counted(self) -> Outcome:
        links = self._links.values()
        self.outcome.cuts = sum(link.cuts for link in links)
        self.outcome.connections = sum(link.connections for link in links)
        self.outcome.size_bytes = sum(link.size_bytes for link in links)
        return self.outcome
