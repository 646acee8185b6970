#!/usr/bin/env python3
"""Clicks an object and saves it as a .ply, through the studio's API. `segwild serve runs/trevi` prints ADDRESS.

    python3 studio.py ADDRESS PHOTO --positive X,Y ... [--negative X,Y ...] [--name NAME]
"""
import argparse
import json
import sys
import time
from urllib import error, parse, request


class Studio:
    """One run of a server."""

    def __init__(self, address, run=None):
        parts = parse.urlsplit(address)
        self.token = parse.parse_qs(parts.query)["token"][0]
        self.base = f"{parts.scheme}://{parts.netloc}/api/v1/runs"
        self.base += "/" + parse.quote(run or self.ask("")[0]["name"])
        while "photos" not in (description := self.ask("")):
            time.sleep(0.2)  # the scene is being loaded, or trained
        self.photos = [photo["name"] for photo in description["photos"]]

    def open(self, path, body=None):
        data = None if body is None else json.dumps(body).encode()
        try:
            return request.urlopen(request.Request(self.base + path, data, {"Authorization": "Bearer " + self.token}))
        except error.HTTPError as refusal:
            sys.exit("error: " + json.load(refusal)["error"])

    def ask(self, path, body=None):
        return json.load(self.open(path, body))

    def click(self, photo, points):
        """Requests the object at points of a photo; yields its answer at every step."""
        prompts = [{"photo": self.photos.index(photo), "points": points}]
        number = self.ask("/act", {"do": "prompt", "prompts": prompts})["answer"]["number"]
        for line in self.open("/events"):
            answer = json.loads(line[5:])["answer"] if line.startswith(b"data:") else {"number": 0}
            if answer["number"] >= number:
                yield answer
                if answer["state"] != "working":
                    return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(usage=__doc__)
    for name in ("address", "photo", "--name"):
        parser.add_argument(name, default="object")
    for name, inside in (("--positive", True), ("--negative", False)):
        point = lambda at, inside=inside: dict(zip("xy", map(float, at.split(","))), inside=inside)
        parser.add_argument(name, nargs="+", default=[], type=point)
    args = parser.parse_args()
    studio = Studio(args.address)
    for answer in studio.click(args.photo, args.positive + args.negative):
        print(answer["state"], answer["error"] or f"{answer['splats']} splats, {answer['step']}, {answer['seconds']:.2f} s")
    kept = studio.ask("/act", {"do": "keep", "name": args.name})["objects"][-1]
    with open(args.name + ".ply", "wb") as file:
        file.write(studio.open(f"/objects/{kept['id']}/ply").read())
