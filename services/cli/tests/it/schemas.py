"""Checks files of Kubernetes and of Compose by their schemas: a line for each document and version.

    python3 schemas.py [DEFINITION.yaml ..] FILE.yaml ..

A DEFINITION is a CustomResourceDefinition: objects of its kind in the files after it are checked by it. Unknown fields are
refused everywhere. Packages: .ci/schemas.txt.
"""

import importlib.util
import json
import pathlib
import sys

import jsonschema
import kubernetes_validate
import yaml

# The oldest version that docs/guide/farm.md names, and the newest that the package knows.
VERSIONS = ["1.29", kubernetes_validate.latest_version()]


def compose_schema():
    """The schema of Compose files. The package that has it is not imported: it wants others."""
    package = importlib.util.find_spec("check_jsonschema").submodule_search_locations[0]
    return json.loads(pathlib.Path(package, "builtin_schemas/vendor/compose-spec.json").read_text())


def closed(schema):
    """A schema of a definition, in which no object has fields that are not named."""
    if isinstance(schema, list):
        return [closed(part) for part in schema]
    if not isinstance(schema, dict):
        return schema
    schema = {name: closed(part) for name, part in schema.items()}
    if isinstance(schema.get("properties"), dict) and not schema.get("x-kubernetes-preserve-unknown-fields"):
        schema.setdefault("additionalProperties", False)
    return schema


def definitions(document):
    """The kinds that a definition defines, with their schemas; the cluster itself checks names and labels."""
    spec = document["spec"]
    for version in spec["versions"]:
        schema = closed(version["schema"]["openAPIV3Schema"])
        schema["properties"]["metadata"] = {"type": "object"}
        yield (f"{spec['group']}/{version['name']}", spec["names"]["kind"]), schema


def refused_by(schema, document):
    """What a schema refuses first; None where it refuses nothing."""
    validator = jsonschema.validators.validator_for(schema, jsonschema.Draft202012Validator)(schema)
    error = next(validator.iter_errors(document), None)
    return error and f"{error.json_path}: {error.message}"


def refused_by_kubernetes(version, document):
    """The same for what Kubernetes has itself."""
    try:
        kubernetes_validate.validate(document, version, strict=True)
    except kubernetes_validate.ValidationError as error:
        return f"{'.'.join(map(str, error.path))}: {error.message}"
    except kubernetes_validate.SchemaNotFoundError:
        return "no schema"
    return None


def main(files):
    defined = {}
    for file in files:
        for document in yaml.safe_load_all(pathlib.Path(file).read_text()):
            kind = (document.get("apiVersion"), document.get("kind"))
            if kind[1] == "CustomResourceDefinition":
                defined.update(definitions(document))
                continue
            if kind == (None, None):
                found = [("Compose", refused_by(compose_schema(), document))]
            elif kind in defined:
                found = [(kind[1], refused_by(defined[kind], document))]
            else:
                found = [(f"{kind[1]} {v}", refused_by_kubernetes(v, document)) for v in VERSIONS]
            for what, refused in found:
                print(f"{file}: {what}: {refused or 'passes'}")


main(sys.argv[1:])
