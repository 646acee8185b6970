#!/usr/bin/env python3
"""Serves a model that answers clicks to segwild, by the messages of proto/segwild/v1/vision.proto.

    pip install grpcio-tools numpy                       # and sam2, which brings torch
    python3 vision_server.py facebook/sam2.1-hiera-tiny
    segwild run photos --out runs/trevi --masks grpc://127.0.0.1:50051

For another model, write a class like `Sam2`: a key, and logits of masks for points and a box.

Objects by text need a model of texts as well; write a class like `Clip`: a key, and vectors of texts and of images.

    pip install transformers
    python3 vision_server.py facebook/sam2.1-hiera-tiny --texts openai/clip-vit-base-patch32
    segwild segment runs/trevi --text "the dome" --vision-service grpc://127.0.0.1:50051
"""

import argparse
import collections
import os
import threading
from concurrent import futures
import sys

import grpc
import numpy as np

sys.path.append(os.environ.get("SEGWILD_PROTO", os.path.join(os.path.dirname(os.path.abspath(__file__)), "../../proto")))
pb, rpc = grpc.protos_and_services("segwild/v1/vision.proto")


class Sam2:
    """SAM 2 (Ravi et al. 2024)."""

    def __init__(self, name):
        from sam2.sam2_image_predictor import SAM2ImagePredictor

        self.key, self.image, self.predictor = name, None, SAM2ImagePredictor.from_pretrained(name)

    def predict(self, image, points, positive, box):
        """Logits (n, height, width) and expected IoU (n) of masks, for an image (height, width, 3) of bytes."""
        if image is not self.image:
            self.predictor.set_image(image)
            self.image = image
        return self.predictor.predict(points, positive, box, return_logits=True)[:2]


class Clip:
    """CLIP (Radford et al. 2021), by Hugging Face's Transformers."""

    def __init__(self, name):
        import transformers

        self.key = name
        self.tokens = transformers.AutoTokenizer.from_pretrained(name)
        self.pixels = transformers.AutoImageProcessor.from_pretrained(name)
        self.words = transformers.CLIPTextModelWithProjection.from_pretrained(name)
        self.vision = transformers.CLIPVisionModelWithProjection.from_pretrained(name)

    def embed_texts(self, texts):
        """Vectors (n, d) of texts."""
        tokens = self.tokens(texts, padding=True, truncation=True, return_tensors="pt")
        return self.words(**tokens).text_embeds.detach().numpy()

    def embed_crops(self, images):
        """Vectors (n, d) of square images (side, side, 3) of bytes."""
        pixels = self.pixels(images, input_data_format="channels_last", return_tensors="pt")
        return self.vision(**pixels).image_embeds.detach().numpy()


class FloodFill:
    """No model: what has the colour of the first click, for trying the connection out."""

    key = "flood fill"

    def predict(self, image, points, positive, box):
        x, y = points[0] if points is not None else (box[:2] + box[2:]) / 2
        alike = np.abs(image.astype(int) - image[int(y), int(x)]).max(axis=2) < 24
        return np.where(alike, 9.0, -9.0)[None], np.array([0.95])


class Colours:
    """No model of texts: the colours that they name against the mean colour, for trying the connection out."""

    key = "colours"
    names = {"red": (1, 0, 0), "green": (0, 1, 0), "blue": (0, 0, 1), "yellow": (1, 1, 0), "white": (1, 1, 1)}

    def embed_texts(self, texts):
        colours = [[rgb for name, rgb in self.names.items() if name in text.split()] for text in texts]
        return [[*np.mean(named or [(0.5, 0.5, 0.5)], axis=0) - 0.5, 0.5] for named in colours]

    def embed_crops(self, images):
        return [[*image.mean(axis=(0, 1)) / 255 - 0.5, 0.5] for image in images]


def vectors(embedded):
    return [pb.EmbeddingVector(numbers=(np.array(v) / np.linalg.norm(v)).tolist()) for v in embedded]


def scored(logits, iou):
    mask = (logits > 0).ravel()
    edges = np.flatnonzero(np.diff(mask, prepend=False))
    runs = np.diff(np.concatenate([[0], edges, [mask.size]]))
    pixels = pb.Mask(width=logits.shape[1], height=logits.shape[0], runs=runs.tolist())
    stability = (logits > 1).sum() / max((logits > -1).sum(), 1)
    return pb.ScoredMask(mask=pixels, predicted_iou=float(np.clip(iou, 0, 1)), stability=float(stability))


class Vision(rpc.VisionServicer):
    def __init__(self, model, texts):
        self.model, self.texts = model, texts
        self.lock, self.images = threading.Lock(), collections.OrderedDict()

    def held(self, names, context):
        if any(name not in self.images for name in names):
            context.abort(grpc.StatusCode.NOT_FOUND, "put the image first")
        return [self.images[name] for name in names]

    def predict(self, request, context, points, positive, box):
        with self.lock:
            return self.model.predict(self.held([request.image], context)[0], points, positive, box)

    def model_of_texts(self, context):
        return self.texts or context.abort(grpc.StatusCode.UNIMPLEMENTED, "start it with --texts NAME for texts")

    def Describe(self, request, context):
        calls = (pb.CAPABILITY_PROPOSE_MASKS, pb.CAPABILITY_SEGMENT_PROMPTS)
        models = [pb.Model(capability=call, key=self.model.key) for call in calls]
        if self.texts:
            models.append(pb.Model(capability=pb.CAPABILITY_EMBED_TEXT, key=self.texts.key))
        return pb.DescribeResponse(name=self.model.key, models=models, pixel_format=pb.PIXEL_FORMAT_U8, parallel=1)

    def PutImage(self, parts, context):
        header = next(parts).header
        numbers = b"".join(part.numbers for part in parts)
        with self.lock:
            self.images[header.hash] = np.frombuffer(numbers, np.uint8).reshape(header.height, header.width, 3)
            while len(self.images) > 128:
                self.images.popitem(last=False)
        return pb.PutImageResponse()

    def ProposeMasks(self, request, context):
        for point in request.points:
            yield from map(scored, *self.predict(request, context, np.array([[point.x, point.y]]), np.array([1]), None))

    def SegmentPrompts(self, request, context):
        points = np.array([[point.at.x, point.at.y] for point in request.points]) if request.points else None
        positive = np.array([point.positive for point in request.points]).astype(int) if request.points else None
        corners = [(box.corner.x, box.corner.y, box.opposite.x, box.opposite.y) for box in request.boxes]
        masks, iou = self.predict(request, context, points, positive, np.array(corners[0]) if corners else None)
        best = int(np.argmax(iou))
        return pb.SegmentPromptsResponse(answer=scored(masks[best], iou[best]))

    def EmbedText(self, request, context):
        model = self.model_of_texts(context)
        with self.lock:
            return pb.EmbedTextResponse(vectors=vectors(model.embed_texts(list(request.texts))))

    def EmbedCrops(self, request, context):
        model = self.model_of_texts(context)
        with self.lock:
            return pb.EmbedCropsResponse(vectors=vectors(model.embed_crops(self.held(request.images, context))))


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description="Serves a model that answers clicks to segwild.")
    arguments.add_argument("model", help="name of a SAM 2 model, or `flood-fill` for none")
    arguments.add_argument("--texts", help="name of a CLIP model for objects by text, or `colours` for none")
    arguments.add_argument("--listen", default="127.0.0.1:50051")
    arguments = arguments.parse_args()
    server = grpc.server(futures.ThreadPoolExecutor(4))
    model = FloodFill() if arguments.model == "flood-fill" else Sam2(arguments.model)
    texts = Colours() if arguments.texts == "colours" else arguments.texts and Clip(arguments.texts)
    service = Vision(model, texts)
    rpc.add_VisionServicer_to_server(service, server)
    host = arguments.listen.rsplit(":", 1)[0]
    print(f"serving {service.model.key} at grpc://{host}:{server.add_insecure_port(arguments.listen)}", flush=True)
    server.start()
    server.wait_for_termination()
