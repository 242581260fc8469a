"""The paper's tables and figures on any data set: conditions, runs over sequences, tables of results."""
