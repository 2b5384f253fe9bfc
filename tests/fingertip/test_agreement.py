"""Which load three samples of a force/torque board agree on."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from skin_host.bus.strain import Wrench
from skin_host.fingertip.agreement import AROUND, Agreement

NUMBERS = st.floats(-100.0, 100.0)
SAMPLES = st.lists(
    st.tuples(st.tuples(*[NUMBERS] * 6), st.booleans()), min_size=AROUND, max_size=12
)


@given(SAMPLES)
def test_each_channel_is_the_median_of_a_sample_and_its_neighbours(
    samples: list[tuple[tuple[float, ...], bool]],
) -> None:
    agreement = Agreement()
    found = [
        agreement.take(Wrench(t_ns, np.array(load[:3]), np.array(load[3:]), saturated))
        for t_ns, (load, saturated) in enumerate(samples)
    ]
    assert found[: AROUND - 1] == [None] * (AROUND - 1)
    for last, one in enumerate(found[AROUND - 1 :], AROUND - 1):
        assert one is not None
        around = samples[last - AROUND + 1 : last + 1]
        loads = np.median([load for load, _ in around], axis=0)
        assert [*one.force_n, *one.torque_nm] == loads.tolist()
        assert one.saturated == (sum(saturated for _, saturated in around) > AROUND // 2)
        assert one.t_ns == last - AROUND // 2
