"""Return the rows of a select as a data frame of pandas, polars or Arrow, or as a stream of Arrow batches.

| declared type of the column | Arrow, Parquet, polars | pandas |
|---|---|---|
| integer | int64 | int64; Int64 if a value is missing |
| number | float64 | float64 |
| bool | bool | bool; boolean if a value is missing |
| text | string | the text type of pandas |
| enum member | dictionary of its names | its name, as text |
| time | timestamp in µs, UTC | datetime64[us, UTC] |
| JSON | its text | the value |

The type of a column is that of its SQLAlchemy expression and never derived from the values, so that a column without
any value has it too. Only an expression without a type, such as `func.round(...)`, gets that of its first values.
SQLAlchemy gives `func.sum` the type of what it sums, so a sum of a bool column is a bool: sum `cast(column, Integer)`.
"""
