"""What a recording holds, row by row."""

from toolkit.inspection.recording import viewer


def entities(path):
    """Entity -> its rows, each a dictionary of what is not empty; the layout's left out."""
    rows = {}
    for chunk in viewer.reader_of(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            rows.setdefault(chunk.entity_path, []).append({key: value for key, value in row.items() if value is not None})
    return rows
