"""What a recording holds, row by row."""

import numpy as np

from toolkit.inspection.recording import viewer


def entities(path):
    """Entity -> its rows, each a dictionary of what is not empty; the layout's left out."""
    rows = {}
    for chunk in viewer.reader_of(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            rows.setdefault(chunk.entity_path, []).append({key: value for key, value in row.items() if value is not None})
    return rows


def seconds(row):
    """When a row is on the film [s]; furniture stands there at all times."""
    return row["film"].total_seconds() if "film" in row else -np.inf


def film_of(path):
    """Entity -> its rows that are on the film, in order."""
    rows = {entity: [row for row in own if "film" in row] for entity, own in entities(path).items()}
    return {entity: sorted(own, key=seconds) for entity, own in rows.items() if own}
