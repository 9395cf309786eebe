"""Tables of numbers and texts in text, YAML, JSON, XML and array files, without the meaning of their columns."""

from jcr.capture.documents.plain import read_content as read_content
from jcr.capture.documents.plain import root_of_xml as root_of_xml
from jcr.capture.documents.read import read_record_tables as read_record_tables
from jcr.capture.documents.read import read_tables as read_tables
from jcr.capture.documents.table import Cell as Cell
from jcr.capture.documents.table import Table as Table
