"""The history of the schema, applied by `services.database.Database.upgrade`."""
