"""Reads a bag with bagpy: `bagpy_client.py BAG TOPIC` prints the topics, and the rows of one topic, as JSON."""

import json
import sys

import pandas as pd
from bagpy import bagreader

bag, topic = sys.argv[1:]
reader = bagreader(bag, verbose=False)
rows = pd.read_csv(reader.message_by_topic(topic))
content = {
    "topics": {row["Topics"]: [row["Types"], row["Message Count"]] for _, row in reader.topic_table.iterrows()},
    "columns": list(rows.columns),
    "rows": rows.astype(str).to_numpy().tolist(),
}
sys.stdout.write(json.dumps(content) + "\n")
