"""The face and the memory of orthostream: HTTP, pages, tables, objects, queue names."""
