"""Golden file of messages: inputs that dynsim rejects or warns about, and the message for each of them.

``messages.txt`` lists them. After a message has changed on purpose, write the file again and review its diff::

    PYTHONPATH=.:tests python -m messages
"""
