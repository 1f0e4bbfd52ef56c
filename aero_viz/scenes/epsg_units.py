"""Coordinate systems of the EPSG registry (12.2) whose unit is a foot, for files that name no unit."""

from __future__ import annotations

from functools import cache

FOOT, US_FOOT = 0.3048, 1200 / 3937
"""The international foot and the US survey foot [m]."""

_IN_US_FEET = (
    "2155 2194 2204 2225-2250 2254-2263/3 2255-2267/3 2259-2262 2268-2277/3 2272-2278/2 2275-2279 2283-2289 "
    "2870-2895 2899-2911/3 2900-2906/2 2903-2907 2912-2918/3 2916-2920 2924-2930 2964-2968 3089-3091/2 3102 "
    "3363-3365/2 3404 3417-3438 3441-3446 3451-3459 3485-3487/2 3490-3512/2 3515-3553/2 3560-3570 3582-3586/2 "
    "3598-3600/2 3608-3632/2 3640-3642/2 3650-3654/2 3658-3664/2 3668-3674/2 3677-3686/3 3688-3692/2 3696-3700/2 "
    "3728-3739 3753-3760 3991-3992 4217 4399-4413 4418-4433 4438-4457 5623-5625 5646 5654-5655 6200-6202 "
    "6411-6413/2 6416-6438/2 6441-6479/2 6484-6492/2 6501-6507/2 6510 6517-6543/2 6549-6555/2 6563-6565/2 6568 "
    "6572-6578/2 6582-6590/2 6593-6609/2 6612-6618/2 6625-6627 6633 6880 6923-6925/2 6966 6997 7057-7070 "
    "7128-7132/2 7258-7370/2 7407 7587-7645 8035-8036 8091-8093/2 8096-8182/2 8177-8189/3 8185 8193-8197/2 "
    "8200-8210/2 8213-8216/3 8220-8226/3 8224 8380-8384/2 8387 8518-8540 8712-8800 9748-9749 10481 10516 10622 "
    "23301-23333 26729-26813 26847-26870 32001-32058 32064-32077 32099 32164-32167 32664-32667 "
)
"""Codes of horizontal and compound systems; 3485-3489/2 is 3485, 3487, 3489."""
_IN_FEET = (
    "2222-2224 2251-2253 2256 2265-2266 2269-2270 2273 2280-2282 2867-2869 2896-2898 2901 2909-2910 2913-2914 "
    "2921-2923 2992-2994/2 3080 3359-3361/2 3479-3483/2 3588-3590/2 3593 3605 3634-3636/2 3644-3648/2 3656 "
    "3676-3682/3 5588 6128-6141 6391 6405-6409/2 6494-6496/2 6499 6515 6545-6547/2 6557-6561/2 6570 6785-6863/2 "
    "6868 6885-6887/2 7119-7127 8065-8068 8312-8348/2 8700-8711 20050 "
)
_HEIGHTS_IN_US_FEET = "5702 6358-6360 8052-8053"
_HEIGHTS_IN_FEET = "5614 6130-6132 8050-8051 8228 8897"


def unit_of_system(code: int) -> float | None:
    """Return the unit of the plane of a projected or compound system [m], None if it is not a foot."""
    return FOOT if code in _codes(_IN_FEET) else US_FOOT if code in _codes(_IN_US_FEET) else None


def unit_of_heights(code: int) -> float | None:
    """Return the unit of a vertical system [m], None if it is not a foot."""
    return FOOT if code in _codes(_HEIGHTS_IN_FEET) else US_FOOT if code in _codes(_HEIGHTS_IN_US_FEET) else None


@cache
def _codes(text: str) -> frozenset[int]:
    codes: set[int] = set()
    for part in text.split():
        span, _, step = part.partition("/")
        first, _, last = span.partition("-")
        codes.update(range(int(first), int(last or first) + 1, int(step or 1)))
    return frozenset(codes)
