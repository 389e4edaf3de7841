"""A stand-in for the server of marking, until that is there: answers the contract from the truth of the demo."""

from __future__ import annotations

import csv
import io
import json
import math
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, unquote, urlparse

import cv2
import numpy as np

SECRET = "s3cret"
PAGE = Path(__file__).parents[3] / "sfm/products/marking/page"
TILE = 510
POLICY = "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'"


class Fake:
    def __init__(self, folder: Path) -> None:
        self.paths = sorted(folder.glob("*.jpg"))
        rows = list(csv.DictReader((folder / "truth_image_points.csv").open()))
        names = {p.name: i for i, p in enumerate(self.paths)}
        keys = list(rows[0])
        self.truth: dict[int, dict[str, tuple[float, float]]] = {i: {} for i in names.values()}
        for row in rows:
            image, point = row[keys[0]], row[keys[1]]
            self.truth[names[image]][point] = (float(row[keys[2]]), float(row[keys[3]]))
        self.xyz = {}
        for row in csv.DictReader((folder / "truth_points.csv").open()):
            values = list(row.values())
            self.xyz[values[0]] = [float(v) for v in values[2:5]]
        self.marks: list[dict[str, Any]] = []
        self.of: dict[str, str] = {}
        self.refused: set[tuple[int, str]] = set()
        self.bars: list[Any] = []
        self.controls: dict[str, Any] = {}
        self.version = 1
        self.past: list[Any] = []
        self.run: Any = None
        self.change = threading.Condition()

    def size(self, i: int) -> tuple[int, int]:
        return (1600, 1200)

    def oriented(self) -> dict[int, int]:
        by: dict[int, set[str]] = {}
        for m in self.marks:
            by.setdefault(m["image"], set()).add(m["point"])
        done: set[int] = set()
        images = sorted(by, key=lambda i: -len(by[i]))
        for a in images:
            for b in images:
                if a < b and len(by[a] & by[b]) >= 5 and not done:
                    done = {a, b}
        known = {p for p in self.of if sum(p in by[i] for i in done) >= 2} if done else set()
        for i in images:
            if done and len(by[i] & known) >= 3:
                done.add(i)
        return {
            i: (0 if i in done else max(0, (3 if done else 5) - len(by.get(i, ()))))
            for i in range(len(self.paths))
        }

    def state(self) -> dict[str, Any]:
        needs = self.oriented()
        rng = np.random.default_rng(3)
        points = []
        done = {i for i in needs if needs[i] == 0 and any(m["image"] == i for m in self.marks)}
        proposals = []
        lines = []
        for p, truth in self.of.items():
            rays = [m for m in self.marks if m["point"] == p]
            if not rays:
                continue
            good = [m for m in rays if m["image"] in done]
            X = self.xyz.get(truth) if len(good) >= 2 else None
            points.append(
                {
                    "name": p,
                    "X": X,
                    "sigma": [0.01, 0.012, 0.02] if X else None,
                    "rays": len(rays),
                    "control": self.controls.get(p),
                    "measured automatically": False,
                }
            )
            if good:
                for i in done:
                    if (
                        all(m["image"] != i for m in rays)
                        and truth in self.truth[i]
                        and (i, p) not in self.refused
                    ):
                        x, y = self.truth[i][truth]
                        if len(good) >= 2:
                            proposals.append(
                                {
                                    "image": i,
                                    "point": p,
                                    "x": x,
                                    "y": y,
                                    "measured": p[-1] != "4",
                                    "kind": "target",
                                    "sigma": [0.02, 0.02],
                                    "ellipse": {"a": 14, "b": 6, "angle_deg": 30},
                                }
                            )
                        else:
                            lines.append(
                                {"image": i, "point": p, "xy": [[x - 300, y - 80], [x, y], [x + 300, y + 82]]}
                            )
        marks = []
        for m in self.marks:
            solved = m["image"] in done
            marks.append(
                {
                    **m,
                    "residual": list(rng.normal(0, 0.05, 2)) if solved else None,
                    "test": float(rng.normal()) if solved else None,
                    "automatic": False,
                }
            )
        worst = max((m for m in marks if m["test"]), key=lambda m: abs(m["test"]), default=None)
        return {
            "version": self.version,
            "name": "demo",
            "unit": "mm",
            "photographs": [
                {
                    "index": i,
                    "name": p.name,
                    "width": 1600,
                    "height": 1200,
                    "oriented": i in done,
                    "marks": sum(m["image"] == i for m in self.marks),
                    "needs": needs[i],
                    "changed": None,
                }
                for i, p in enumerate(self.paths)
            ],
            "points": points,
            "marks": marks,
            "proposals": proposals,
            "lines": lines,
            "bars": self.bars,
            "adjustment": {
                "state": "done" if done else "none",
                "sigma0_px": 0.052 if done else None,
                "redundancy": 31 if done else None,
                "worst": {
                    "image": worst["image"],
                    "point": worst["point"],
                    "test": worst["test"],
                    "flagged": abs(worst["test"]) > 2.5,
                }
                if worst
                else None,
                "sentence": "12 photographs, 8 points." if done else "Nothing is adjusted yet.",
            },
            "next": f"{self.paths[0].name} and {self.paths[1].name} need {needs[0]} more common points until they are oriented.",
            "can_undo": bool(self.past),
            "can_redo": False,
            "saved": "/home/user/part/marks.csv",
            "run": self.run,
        }

    def do(self, what: str, body: dict[str, Any]) -> tuple[int, Any]:
        with self.change:
            self.past.append(json.dumps([self.marks, self.of]))
            if what == "click":
                i = body["image"]
                away = {n: math.dist(xy, (body["x"], body["y"])) for n, xy in self.truth[i].items()}
                truth = min(away, key=away.__getitem__)
                name = body["point"] or f"P{len(self.of) + 1}"
                if body["kind"] == "hand":
                    xy, by, s = (body["x"], body["y"]), "hand", body["sigma_px"]
                elif away[truth] > 12:
                    self.past.pop()
                    return 422, {"error": "Nothing can be measured within 12 px of this place."}
                else:
                    xy, by, s = self.truth[i][truth], "measured", 0.02
                self.of.setdefault(name, truth)
                mark = {
                    "image": i,
                    "point": name,
                    "x": xy[0],
                    "y": xy[1],
                    "sigma": [s, s],
                    "kind": body["kind"] or "target",
                    "by": by,
                    "when": "2026-11-29T10:00:00Z",
                }
                self.marks = [m for m in self.marks if (m["image"], m["point"]) != (i, name)] + [mark]
                self.version += 1
                self.change.notify_all()
                return 200, {"mark": mark, "state": self.state()}
            if what == "accept":
                for q in self.state()["proposals"]:
                    if (
                        body.get("point", q["point"]) == q["point"]
                        and body.get("image", q["image"]) == q["image"]
                        and q["measured"]
                    ):
                        self.marks.append(
                            {
                                "image": q["image"],
                                "point": q["point"],
                                "x": q["x"],
                                "y": q["y"],
                                "sigma": [0.02, 0.02],
                                "kind": "target",
                                "by": "measured",
                                "when": "",
                            }
                        )
            elif what == "refuse":
                for q in self.state()["proposals"]:
                    if (
                        body.get("point", q["point"]) == q["point"]
                        and body.get("image", q["image"]) == q["image"]
                    ):
                        self.refused.add((q["image"], q["point"]))
            elif what == "delete":
                self.marks = [
                    m
                    for m in self.marks
                    if m["point"] != body["point"] or body.get("image", m["image"]) != m["image"]
                ]
            elif what == "rename":
                self.of[body["name"]] = self.of.pop(body["point"])
                for m in self.marks:
                    if m["point"] == body["point"]:
                        m["point"] = body["name"]
            elif what == "control":
                self.controls[body["point"]] = {
                    "X": [body["X"], body["Y"], body["Z"]],
                    "sigma": body["sigma"],
                }
            elif what == "bar":
                self.bars.append({**body, "residual": None})
            elif what == "undo":
                self.past.pop()
                self.marks, self.of = json.loads(self.past.pop())
            elif what == "automatic":
                self.run = {
                    "state": "running",
                    "stage": "targets",
                    "report": None,
                    "sentence": "photograph 3 of 12",
                }
            self.version += 1
            self.change.notify_all()
            return 200, self.state()


def start(folder: Path, port: int = 0) -> tuple[ThreadingHTTPServer, str]:
    fake = Fake(folder)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: Any) -> None:
            pass

        def answer(self, code: int, data: bytes, kind: str) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(data)))
            self.send_header("Content-Security-Policy", POLICY)
            self.end_headers()
            self.wfile.write(data)

        def do_GET(self) -> None:  # noqa: N802
            url = urlparse(self.path)
            parts = [unquote(p) for p in url.path.split("/")[2:]]
            if parts in ([""], ["mark.js"], ["mark.css"]):
                name = parts[0] or "mark.html"
                kinds = {"html": "text/html", "js": "text/javascript", "css": "text/css"}
                return self.answer(
                    200, (PAGE / name).read_bytes(), kinds[name.rsplit(".")[-1]] + "; charset=utf-8"
                )
            if parts == ["state"]:
                after = parse_qs(url.query).get("after")
                with fake.change:
                    if after:
                        fake.change.wait_for(lambda: fake.version > int(after[0]), 25)
                    return self.answer(200, json.dumps(fake.state()).encode(), "application/json")
            if parts == ["sight"]:
                q = parse_qs(url.query)
                lines = [
                    {"image": j, "xy": [[0, 100 + float(q["y"][0])], [1599, float(q["y"][0])]]}
                    for j in range(12)
                    if j != int(q["image"][0])
                ]
                return self.answer(200, json.dumps({"lines": lines}).encode(), "application/json")
            if parts[0] == "tiles" and parts[1].endswith(".dzi"):
                w, h = 1600, 1200
                text = f'<?xml version="1.0"?><Image xmlns="http://schemas.microsoft.com/deepzoom/2008" TileSize="{TILE}" Overlap="1" Format="jpg"><Size Width="{w}" Height="{h}"/></Image>'
                return self.answer(200, text.encode(), "application/xml")
            if parts[0] == "tiles":
                i, level = int(parts[1].split("_")[0]), int(parts[2])
                c, r = (int(v) for v in parts[3].removesuffix(".jpg").split("_"))
                picture = cv2.imread(str(fake.paths[i]))
                f = 2 ** (11 - level)
                w, h = math.ceil(1600 / f), math.ceil(1200 / f)
                small = cv2.resize(picture, (w, h), interpolation=cv2.INTER_AREA)
                x0, y0 = max(0, c * TILE - 1), max(0, r * TILE - 1)
                tile = small[y0 : (r + 1) * TILE + 1, x0 : (c + 1) * TILE + 1]
                return self.answer(200, cv2.imencode(".jpg", tile)[1].tobytes(), "image/jpeg")
            if parts[0] == "fit":
                i, name = int(parts[1]), parts[2].removesuffix(".png")
                m = next(m for m in fake.marks if m["image"] == i and m["point"] == name)
                picture = cv2.imread(str(fake.paths[i]))
                x, y = round(m["x"]), round(m["y"])
                crop = cv2.resize(
                    picture[max(0, y - 12) : y + 13, max(0, x - 12) : x + 13],
                    None,
                    fx=8,
                    fy=8,
                    interpolation=cv2.INTER_NEAREST,
                )
                return self.answer(200, cv2.imencode(".png", crop)[1].tobytes(), "image/png")
            self.answer(404, b"{}", "application/json")

        def do_POST(self) -> None:  # noqa: N802
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            assert self.headers["X-Kolinear"] == SECRET
            code, told = fake.do(self.path.split("/")[2], body)
            self.answer(code, json.dumps(told).encode(), "application/json")

    server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    server.fake = fake  # type: ignore[attr-defined]
    return server, f"http://127.0.0.1:{server.server_port}/{SECRET}/"
