"""Records: their signals, files, exports, figures, films and pages."""

from messages.case import Calls, Commands
from messages.stock import PENDULUM, PRESSURE, TWO_JOINTS

AREA = "Records, figures and films"
ORDER = 120

TABLES = [
    Calls(
        [
            ("signal that does not exist", "record['qq']"),
            ("number as signal", "record[0]"),
            ("unit of a signal that does not exist", "record.units['qq']"),
            ("entry of the summary that does not exist", "record.summary['step']"),
            ("entry of the provenance that does not exist", "record.provenance['scenario']"),
            ("number as summary", "record.summary = 3"),
            ("signal with too few samples", "record.add('p', np.zeros(4), 'm')"),
            ("signal with too few labels", "record.add('p', np.zeros((5, 2)), 'm', labels=('x',))"),
            ("signal of texts", "record.add('p', ['a'] * 5, 'm')"),
            ("signal of four axes", "record.add('p', np.zeros((5, 1, 1, 1)), 'm')"),
            ("signal on a time axis that does not exist", "record.add('p', np.zeros(5), 'm', axis='camera')"),
            ("signal with a slash in its name", "record.add('p/q', np.zeros(5), 'm')"),
            ("time axis twice", "record.add_axis('q', [0.1, 0.2])"),
            ("time axis that runs backwards", "record.add_axis('camera', [0.2, 0.1])"),
            ("event at no time", "record.add_event(math.nan, 'lift_off')"),
            ("time that runs backwards", "dynsim.Record([0.0, 0.2, 0.1]).save('record.h5')"),
            ("time that is not a number", "dynsim.Record([0.0, math.nan]).save('record.h5')"),
            ("time in a matrix", "dynsim.Record(np.zeros((2, 2))).save('record.h5')"),
            ("table on a time axis that does not exist", "record.to_dataframe(axis='camera')"),
        ],
        heading="records in memory",
    ),
    Calls(
        [
            ("record without its time", "edited(\"del file['time']\")"),
            ("record without its summary", "edited(\"del file['summary']\")"),
            ("record of another format", "edited(\"file.attrs['format'] = 'dynsim-record-1'\")"),
            ("HDF5 file of another program", "edited(\"del file.attrs['format']\")"),
            ("record without its mark of completeness", "edited(\"del file.attrs['complete']\")"),
            ("mark of completeness that is a text", "edited(\"file.attrs['complete'] = 'yes'\")"),
            ("time that is a text", "edited(\"del file['time']; file['time'] = 'soon'\")"),
            ("time with a hole", "edited(\"file['time'][2] = np.nan\")"),
            (
                "time of another length in a file",
                "edited(\"del file['time']; file['time'] = np.arange(4.0)\")",
            ),
            ("signal without a unit", "edited(\"del file['signals/q'].attrs['unit']\")"),
            ("signal without labels", "edited(\"del file['signals/q'].attrs['labels']\")"),
            ("signal that is a link", "edited(\"file['signals/s'] = h5py.SoftLink('/time')\")"),
            ("summary that is not JSON", "edited(\"del file['summary']; file['summary'] = 'fine'\")"),
            ("summary that is a list", "edited(\"del file['summary']; file['summary'] = '[1]'\")"),
            ("scene that is not JSON", "edited(\"file['scene'] = '{'\")"),
            ("events of different lengths", "edited(\"del file['events/time']; file['events/time'] = [0.1]\")"),
            ("record that was changed", "edited(\"file['signals/q'][0, 0] = 42.0\", trust=False)"),
            ("record that was cut", "cut(-80)"),
            ("half a record", "cut(3000)"),
            ("text as record", "written(b'hello')"),
            ("folder as record", "dynsim.Record.load('.')"),
            ("record saved to a folder", "record.save('.')"),
            ("record saved below a file", "Path('file').touch(), record.save('file/record.h5')"),
        ],
        heading="record files",
    ),
    Commands(
        [
            ("figures of a file that does not exist", "plot missing.h5"),
            ("figures of a folder without records", "plot ."),
            ("figures of a record of another program", "plot pressure.h5"),
            ("film with a plot of a signal that does not exist", "animate fall.h5 --out film.gif --plot heat"),
            ("film of a record without a scene", "animate two.h5 --out film.gif"),
            ("page of a record without a scene", "view two.h5"),
            ("export of a record without joint motion", "export pressure.h5 --format joint-trajectory"),
            ("export of a scenario as a motion", "export single_pendulum --format csv"),
            ("export of a mobile base as URDF", "export mobile_elbow_comparison --format urdf"),
        ],
        {"fall.h5": PENDULUM, "two.h5": TWO_JOINTS, "pressure.h5": PRESSURE},
    ),
    Commands(
        [
            ("film as another kind of file", "animate fall.h5 --out film.avi"),
            ("film size that is a word", "animate fall.h5 --out film.gif --size large"),
            ("film that is too small", "animate fall.h5 --out film.gif --size 10x10"),
            ("film of odd width", "animate fall.h5 --out film.gif --size 321x240"),
            ("film at speed zero", "animate fall.h5 --out film.gif --speed 0"),
            ("film of very many frames", "animate fall.h5 --out film.gif --speed 0.0000001"),
            ("film of too many frames a second", "animate fall.h5 --out film.gif --fps 200"),
            ("GIF of too many frames a second", "animate fall.h5 --out film.gif --fps 60"),
            ("film with a negative last frame", "animate fall.h5 --out film.gif --hold -1"),
            ("export at a negative rate", "export two.h5 --format joint-trajectory --rate -1"),
            ("export of a record as a robot", "export two.h5 --format urdf"),
            ("rate of the export of a robot", "export single_pendulum --format urdf --rate 10"),
            ("setting of the export of a motion", "export two.h5 --format csv --set duration_s=1"),
            ("export to a folder", "export two.h5 --format csv --out ."),
            ("rate of an MCAP file", "export fall.h5 --format mcap --rate 10"),
        ],
        {"fall.h5": PENDULUM, "two.h5": TWO_JOINTS, "pressure.h5": PRESSURE},
        named=False,
    ),
    Calls(
        [
            ("figure that does not exist", "dynsim.figure(pendulum, 'enrgy')"),
            ("figure without data", "dynsim.figure(pendulum, 'base')"),
            ("figure of no records", "dynsim.figure({}, 'compare_energy')"),
            ("figure of a record of other signals", "dynsim.figure(dynsim.Record([0.0, 1.0]), 'energy')"),
        ],
        heading="figures in Python",
    ),
]
